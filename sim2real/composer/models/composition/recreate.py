"""Elements that are added again to a composed spec: MuJoCo's copies would drop them, or change their references."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.models.mjcf import tendon_paths, translate
from sim2real.composer.models.mjcf.targets import SECTION_KINDS, point, targets
from sim2real.composer.models.mjcf.tendon_paths import path_of
from sim2real.composer.models.mjcf.translate import TREE_KINDS
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sim2real.composer.models.tree import Handle, Tree
    from sim2real.composer.types import MjSpec, Native

_NAMED_BY = {"tendon": ("actuator", "sensor", "equality"), "actuator": ("sensor",)}
"""MuJoCo deletes what names an element together with it: kind of element -> kinds that may name it."""


def closed(kinds: Iterable[str]) -> frozenset[str]:
    """Return the kinds of elements that must be added again together: the given ones, and those that name them."""
    closure = set(kinds)
    for kind, others in _NAMED_BY.items():
        if kind in closure:
            closure.update(others)
    return frozenset(closure | {"tuple"} if closure else closure)


def foreign_kinds(models: list[Tree[Handle]]) -> frozenset[str]:
    """Return the kinds of elements in sections that name elements of other models, as far as programs named those."""
    kinds = set()
    for model in models:
        for (native, _), target in model.references.items():
            if target.root is not model or target.is_removed:
                kinds.add(translate.kind_of(native))
        if any(p.is_outdated(model) for native in model._spec.tendons for p in model.paths.get(native, ())):
            kinds.add("tendon")
    return closed(kinds & set(SECTION_KINDS))


def final_name(target: Handle, top: Tree[Handle]) -> str:
    """Return an element's name in the spec of a world, given the model at its top."""
    above: Tree[Handle] | None = target.root
    while above is not None and above is not top:
        above = above.parent_model
    if above is None:
        raise UsageError(
            f"model {top.model!r} refers to {target.full_identifier!r}, which is not attached below it",
            hint="attach it first, or add the referring element to a model above both",
        )
    return target.full_identifier if top.parent_model is None else target.root.identify(target, relative_to=top)


def named(model: Tree[Handle], element: str, kind: str, target: Handle | str, top: Tree[Handle]) -> str:
    """Return the name, in the spec of a world, of what an element of a model names.

    Args:
        target: The referenced element, or its name.
    """
    # Find the element by its name.
    element_named: Any = target
    if isinstance(target, str):
        if not kind:
            return target
        element_named = model.find(kind, target)
        if element_named is None:
            available = ", ".join(filter(None, (e.name for e in model.find_all(kind, exclude_attachments=True))))
            raise UsageError(
                f"{element} of model {model.model!r} names the {kind} {target!r}, which is not there. "
                f"Available: {available}",
                hint="elements of attached models have the names of those in front: arm/hand/finger",
            )
    # Refuse a removed element by its former name.
    if element_named.is_removed:
        name = element_named.root.removed.get(element_named, "")
        raise UsageError(
            f"{element} of model {model.model!r} names the {kind} {name!r}, which was removed",
            hint=f"remove the {element.split()[0]} as well, or let it name another {kind}",
        )
    return final_name(element_named, top)


def add(out: MjSpec, top: Tree[Handle], models: list[Tree[Handle]], kinds: frozenset[str]) -> None:
    """Add the elements of some kinds of all models to the composed spec, which has none of them yet.

    Args:
        models: All its models, in the order in which their elements follow one another.

    Raises:
        UsageError: When an element names one that is not there.
    """
    for kind in (k for k in SECTION_KINDS if k in kinds):
        for model in models:
            for native in list(getattr(model._spec, translate.plural(kind))):
                element = model.handle(kind, native)
                new = copied(out, kind, native, final_name(element, top))
                what = f"{kind} {element.name or final_name(element, top)!r}"
                for key, target_kind, text in list(targets(kind, native)):
                    target = model.references.get((native, key), text)
                    point(new, key, named(model, what, target_kind, target, top))
                if kind == "tendon":
                    for part in path_of(model, native):
                        tendon_paths.wrap(new, part, lambda k, t, m=model, w=what: named(m, w, k, t, top))


def copied(out: MjSpec, kind: str, native: Native, name: str) -> Native:
    """Add a copy of an element to a spec; its references keep their names, and a tendon has no path yet."""
    new = getattr(out, f"add_{kind}")()
    for key in translate.attributes(native):
        value = getattr(native, key)
        if key == "path" or callable(value) or value is None:
            continue
        if isinstance(value, np.ndarray):
            if value.tobytes() != getattr(new, key).tobytes():
                setattr(new, key, value)
        elif type(value).__name__.endswith("Vec") or value != getattr(new, key):
            setattr(new, key, value)
    new.name, new.info = name, native.info
    if getattr(native, "plugin", None) is not None and native.plugin.active:
        for key in ("name", "plugin_name", "active"):
            setattr(new.plugin, key, getattr(native.plugin, key))
    return new


def point_aside(out: MjSpec, top: Tree[Handle], models: list[Tree[Handle]], done: frozenset[str]) -> None:
    """Set the references of bodies' elements and assets to other models, after all models are in one spec."""
    for model in models:
        for (native, key), target in model.references.items():
            element = model.handle(translate.kind_of(native), native)
            if (target.root is not model or target.is_removed) and element.kind not in done:
                what = f"{element.kind} {element.full_identifier!r}"
                new = getattr(out, element.kind)(final_name(element, top))
                point(new, key, named(model, what, target.kind, target, top))


COUNTED = (*TREE_KINDS, *SECTION_KINDS, *("mesh", "material", "texture", "hfield", "skin", "flex"), "numeric", "text")
"""Elements that are counted before and after a copy."""


def count(spec: MjSpec) -> dict[str, int]:
    """Return how many elements of each kind a spec has; its world is no body."""
    counts = {kind: len(getattr(spec, translate.plural(kind))) for kind in COUNTED}
    counts["body"] -= 1
    return counts


def count_own(model: Tree[Handle]) -> dict[str, int]:
    """Return how many elements of each kind a model has, without those of attached models."""
    if model.counted is None or model.counted[0] is None or model.counted[0] != model.revision():
        model.counted = model.revision(), count(model._spec)
    return model.counted[1]
