"""The attributes of elements of an ``MjSpec`` that name other elements, and the kinds of those."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from sim2real.composer.models import layout
from sim2real.composer.models.mjcf import translate
from sim2real.composer.models.mjcf.translate import mj

if TYPE_CHECKING:
    from sim2real.composer.models.tree import Handle, Tree
    from sim2real.composer.types import Native

_OBJECTS = {**{number: kind for kind, number in layout.OBJECT_TYPES.items()}, mj.mjtObj.mjOBJ_XBODY: "body"}
_TRANSMISSIONS = {
    **{getattr(mj.mjtTrn, f"mjTRN_{name}"): "joint" for name in ("JOINT", "JOINTINPARENT")},
    **{getattr(mj.mjtTrn, f"mjTRN_{name}"): "site" for name in ("SITE", "SLIDERCRANK")},
    mj.mjtTrn.mjTRN_TENDON: "tendon",
    mj.mjtTrn.mjTRN_BODY: "body",
}
_EQUALITIES = {
    mj.mjtEq.mjEQ_JOINT: "joint",
    mj.mjtEq.mjEQ_TENDON: "tendon",
    **{getattr(mj.mjtEq, f"mjEQ_{name}"): "flex" for name in ("FLEX", "FLEXVERT", "FLEXSTRAIN")},
}
"""Equalities of one kind of element; the others have it in ``objtype``."""
FIXED: dict[str, dict[str, str]] = {
    "geom": {"meshname": "mesh", "hfieldname": "hfield", "material": "material"},
    "site": {"meshname": "mesh", "material": "material"},
    "camera": {"targetbody": "body"},
    "light": {"targetbody": "body", "texture": "texture"},
    "mesh": {"material": "material"},
    "material": {"textures": "texture"},
    "skin": {"material": "material", "bodyname": "body"},
    "flex": {"material": "material", "nodebody": "body", "vertbody": "body"},
    "tendon": {"material": "material"},
    "actuator": {"target": "", "refsite": "site", "slidersite": "site"},
    "sensor": {"objname": "", "refname": ""},
    "equality": {"name1": "", "name2": ""},
    "pair": {"geomname1": "geom", "geomname2": "geom"},
    "exclude": {"bodyname1": "body", "bodyname2": "body"},
    "tuple": {"objname": ""},
}
"""Kind of element -> attribute that names others -> their kind; '' where another attribute decides it.

The path of a tendon names elements too: see ``paths``."""
SECTION_KINDS = ("pair", "exclude", "equality", "tendon", "actuator", "sensor", "tuple")
"""Elements outside of bodies with references: MuJoCo drops them from a copy without the referenced elements."""
ALL = frozenset(layout.KINDS)
"""Kinds of elements that are named."""
COSMETIC = ("material", "texture")
"""Kinds that an element works without, when they are removed."""
_IN_CLASSES = {"material", "mesh", "hfield", "texture"}
_IN_DEFAULTS = ("geom", "site", "light", "mesh", "material", "tendon")


def targets(kind: str, native: Native) -> Iterator[tuple[str, str, str]]:
    """Yield the references of an element: attribute like ``target`` or ``textures[1]``, kind and name of the other."""
    for key, named in FIXED.get(kind, {}).items():
        value = getattr(native, key)
        if isinstance(value, str):
            if value:
                yield key, named or _kind_of(kind, native, key, 0), value
        else:
            for i, name in enumerate(value):
                if name:
                    yield f"{key}[{i}]", named or _kind_of(kind, native, key, i), name


def _kind_of(kind: str, native: Native, key: str, number: int) -> str:
    """Return what an attribute names where another attribute decides it; '' where MuJoCo has no name for it."""
    if kind == "actuator":
        return _TRANSMISSIONS.get(native.trntype, "")
    if kind == "equality" and native.type in _EQUALITIES:
        return _EQUALITIES[native.type]
    if kind == "tuple":
        return _OBJECTS.get(mj.mjtObj(native.objtype[number]), "")
    return _OBJECTS.get(native.reftype if key == "refname" else native.objtype, "")


def by_text(model: Tree[Handle], kinds: Collection[str]) -> Iterator[tuple[Native, str, str, str]]:
    """Yield the references of a model by text alone: the element, attribute, kind and name of the other.

    References that a program made by element do not count, nor do the paths of tendons.
    """
    spec = model._spec
    for kind, attributes in FIXED.items():
        if "" not in attributes.values() and set(attributes.values()).isdisjoint(kinds):
            continue
        for native in getattr(spec, translate.plural(kind)):
            yield from ((native, *t) for t in targets(kind, native) if (native, t[0]) not in model.references)


def of_classes(model: Tree[Handle], kinds: Collection[str]) -> Iterator[tuple[Native, str, str, str]]:
    """Yield the references in classes of defaults, as ``by_text`` does."""
    for name in model.records.class_names() if not _IN_CLASSES.isdisjoint(kinds) else ():
        for kind in _IN_DEFAULTS:
            native = getattr(model._spec.find_default(name), kind)
            yield from ((native, *t) for t in targets(kind, native))


def point(native: Native, key: str, name: str) -> None:
    """Let an attribute name another element: ``target``, or ``textures[1]`` where there are several.

    Args:
        key: The attribute, in the spelling of ``MjSpec``.
        name: The other element's name; '' for none.
    """
    key, _, number = key.partition("[")
    if not number:
        setattr(native, key, name)
        return
    names = list(getattr(native, key))
    names[int(number[:-1])] = name
    setattr(native, key, names)
