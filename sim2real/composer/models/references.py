"""Attributes that name other elements: they name them still when those are called otherwise."""

from __future__ import annotations

from sim2real.composer.models import translate
from sim2real.composer.models.tree import Handle, Tree

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
    ),
    "equality": ("body1", "body2", "joint1", "joint2", "tendon1", "tendon2", "site1", "site2"),
    "pair": ("geom1", "geom2"),
    "exclude": ("body1", "body2"),
    "geom": ("mesh", "hfield", "material"),
    "site": ("material",),
    "material": ("texture",),
    "camera": ("target",),
    "light": ("target",),
    "tendon": ("material",),
}
"""Kind of element -> its attributes that name another element."""


def refer(element: Handle, key: str, target: Handle | str | None) -> None:
    """Let an attribute name another element, whatever that is called later.

    Args:
        element: The element that names another one.
        key: The attribute, in the spelling of ``MjSpec``.
        target: The other element, or its name; None: no element any more.
    """
    model: Tree[Handle] = element.root
    if isinstance(target, Handle):
        model.references[element._native, key] = target
        target = target.name or ""
    else:
        model.references.pop((element._native, key), None)
    translate.point(element._native, key, target or "")
    model.touch()


def referenced(element: Handle, name: str) -> Handle | str | None:
    """Return the element that an attribute names, its name where it does not exist, or None."""
    model, said = element.root, element.recorded()
    kind = name.rstrip("12")
    if name in ("objname", "refname"):
        kind = said.values.get(name.replace("name", "type"), "body").replace("xbody", "body")
    key = "target" if element.kind == "actuator" and name in ("joint", "site", "tendon", "body") else None
    key = key or translate.native_name(element.kind, name)
    target = model.references.get((element._native, key))
    text = getattr(element._native, key, said.values.get(name))
    if isinstance(text, Handle):
        return text
    if target is not None or not text:
        return target
    kind = "body" if kind == "target" else kind
    if key == "target" and not hasattr(model._spec, kind):
        return text
    return model.find(kind, text) or text
