"""Attributes that name other elements; they follow when those are renamed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.composer.models.mjcf import targets, translate
from sim2real.composer.models.mjcf.tendon_paths import path_of
from sim2real.composer.models.tree import Handle, Tree

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

REFERENCES = {
    "actuator": ("joint", "jointinparent", "site", "tendon", "body", "refsite", "cranksite", "slidersite"),
    "sensor": (
        "site",
        "joint",
        "body",
        "actuator",
        "tendon",
        "camera",
        "objname",
        "refname",
        "geom1",
        "geom2",
        "body1",
        "body2",
        "subtree1",
        "subtree2",
        "geom",
        "mesh",
    ),
    "equality": ("body1", "body2", "joint1", "joint2", "tendon1", "tendon2", "site1", "site2"),
    "pair": ("geom1", "geom2"),
    "exclude": ("body1", "body2"),
    "geom": ("mesh", "hfield", "material"),
    "site": ("material", "mesh"),
    "mesh": ("material",),
    "material": ("texture",),
    "camera": ("target",),
    "light": ("target", "texture"),
    "tendon": ("material",),
}
"""Kind of element -> its attributes that name another element."""


def refer(element: Handle, key: str, target: Handle | str | None) -> None:
    """Let an attribute name another element; the reference follows later renames.

    Args:
        key: The attribute, in the spelling of ``MjSpec``.
        target: The other element, or its name; None: no element any more.
    """
    model: Tree[Handle] = element.root
    if isinstance(target, Handle):
        model.references[element._native, key] = target
        target = target.name or ""
    else:
        model.references.pop((element._native, key), None)
    targets.point(element._native, key, target or "")
    model.touch()


def referenced(element: Handle, name: str) -> Handle | str | None:
    """Return the element that an attribute names, its name where it does not exist, or None."""
    model, record = element.root, element.recorded()
    key = _native_key(element, name)
    target = model.references.get((element._native, key))
    if target is not None:
        return None if target.is_removed else target
    for attribute, kind, text in targets.targets(element.kind, element._native):
        if attribute == key and model.shows_text:
            return text
        if attribute == key:
            return (model.find(kind, text) if kind else None) or text
    text = record.values.get(name)
    return None if isinstance(text, Handle) and text.is_removed else text


def held(element: Handle, name: str) -> Handle | None:
    """Return the element that an attribute names, where that is held as an element; it may have been deleted."""
    return element.root.references.get((element._native, _native_key(element, name)))


def _native_key(element: Handle, name: str) -> str:
    """Return the attribute of the ``MjSpec`` that holds what an attribute in MJCF names, as MuJoCo's parser puts it."""
    values = element.recorded().values
    naming = tuple(k for k in REFERENCES[element.kind] if k in values)
    plain = {k: v for k, v in values.items() if k.endswith("type") and isinstance(v, str)}
    key = translate.key_of(element.kind, element.tag, name, naming, plain)
    return key or translate.native_name(element.kind, name)


def rename(element: Handle, name: str) -> None:
    """Rename an element; references to it follow."""
    model: Tree[Handle] = element.root
    old = element.name
    if old:
        _hold([element])
    element._native.name = name
    for (native, key), target in model.references.items():
        if target is element:
            targets.point(native, key, name)
    for native, key, kind, text in list(targets.of_classes(model, (element.kind,))) if old else ():
        if (kind, text) == (element.kind, old):
            targets.point(native, key, name)


def hold_below(model: Tree[Handle], prefix: str) -> None:
    """Turn references by text with a prefix into references by element, before a model is renamed.

    Args:
        prefix: The prefix of its names, such as ``arm/``.
    """
    for one in _seeing(model):
        lead = model.prefix(one) + prefix
        _read_paths(one)
        for native, key, kind, text in list(targets.by_text(one, targets.ALL)):
            target = one.find(kind, text) if text.startswith(lead) and kind else None
            if target is not None:
                one.references[native, key] = target


def let_go(model: Tree[Handle], gone: Iterable[Handle]) -> None:
    """Prepare the deletion of elements: what names them holds them as elements, by which it is refused.

    What can do without them, such as a geom without its material, does not name them any more.
    """
    gone = list(gone)
    natives = {element._native for element in gone}
    _hold(gone)
    model.references = {key: target for key, target in model.references.items() if key[0] not in natives}
    model.paths = {native: path for native, path in model.paths.items() if native not in natives}
    for one in model.root_model.all_models():
        for (native, key), target in list(one.references.items()):
            if target in gone and target.kind in targets.COSMETIC:
                del one.references[native, key]
                targets.point(native, key, "")
                one.records.of(native, translate.kind_of(native)).note(target.kind, None)
        held = [*one.references.values(), *(v for path in one.paths.values() for p in path for v in p.values.values())]
        model.removed |= {element: element.name or "" for element in gone if any(element is v for v in held)}
    for native, key, kind, text in list(targets.of_classes(model, {element.kind for element in gone})):
        if any((kind, text) == (element.kind, element.name) for element in gone):
            targets.point(native, key, "")


def _hold(elements: Iterable[Handle]) -> None:
    """Hold references to elements of a model that are named by text."""
    elements = [element for element in elements if element.name]
    for one in _seeing(elements[0].root) if elements else ():
        if any(element.kind in ("joint", "site", "geom") for element in elements):
            _read_paths(one)
        kinds = {element.kind for element in elements}
        named = {(e.kind, e.root.identify(e, relative_to=one)): e for e in elements}
        for native, key, kind, text in list(targets.by_text(one, kinds)):
            if (kind, text) in named:
                one.references[native, key] = named[kind, text]


def _seeing(model: Tree[Handle]) -> Iterator[Tree[Handle]]:
    """Yield a model and all models above it: they can name its elements by text."""
    one: Tree[Handle] | None = model
    while one is not None:
        yield one
        one = one.parent_model


def _read_paths(model: Tree[Handle]) -> None:
    for native in model._spec.tendons:
        path_of(model, native)
