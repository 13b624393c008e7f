"""Paths of tendons, held as elements. An ``MjSpec`` has names there, and does not change them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.composer.models.mjcf.explicit_values import PathPart
from sim2real.composer.models.mjcf.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim2real.composer.models.tree import Handle, Tree
    from sim2real.composer.types import Native, Value

NAMING = {"joint": ("joint",), "site": ("site",), "geom": ("geom", "sidesite"), "pulley": ()}
"""Tag of a part of a path -> its attributes that name elements."""
KIND = {"joint": "joint", "site": "site", "geom": "geom", "sidesite": "site"}
"""Attribute that names an element -> the element's kind."""
ELSEWHERE = "//elsewhere"
"""Placeholder in an ``MjSpec`` for an element of another model: a name that no element has."""
_TAGS = {
    mj.mjtWrap.mjWRAP_JOINT: "joint",
    mj.mjtWrap.mjWRAP_SITE: "site",
    mj.mjtWrap.mjWRAP_SPHERE: "geom",
    mj.mjtWrap.mjWRAP_CYLINDER: "geom",
    mj.mjtWrap.mjWRAP_PULLEY: "pulley",
}


def path_of(model: Tree[Handle], native: Native) -> list[PathPart]:
    """Return the path of a tendon."""
    parts = model.paths.setdefault(native, [])
    parts += [_read(model, native, wrap) for wrap in list(native.path)[len(parts) :]]
    return parts


def _read(model: Tree[Handle], native: Native, wrap: Value) -> PathPart:
    """Return what an ``MjSpec`` or its document has of a part of a path."""
    tag = _TAGS[wrap.type]
    values: dict[str, Value] = {"coef": wrap.coef} if tag == "joint" else {}
    if tag == "pulley":
        return PathPart(tag, {"divisor": wrap.divisor}, {})
    record = model.records.written(wrap)
    for key, target in zip(NAMING[tag], (wrap.target, wrap.sidesite if tag == "geom" else None), strict=False):
        text = None if record is None else record.values.get(key)
        if target is not None:
            values[key] = model.handle(KIND[key], target)
        elif text:
            values[key] = model.find(KIND[key], text) or text
        elif key == tag:
            raise UsageError(f"tendon {native.name!r} of model {model.model!r} runs over a {tag} that is not there")
    return PathPart(tag, values, {k: v.name or "" for k, v in values.items() if hasattr(v, "root")})


def make_part(model: Tree[Handle], tag: str, attrs: dict[str, Value]) -> PathPart:
    """Return a part of a path.

    Args:
        tag: ``joint``, ``site``, ``geom`` or ``pulley``.
    """
    if tag not in NAMING:
        raise UsageError(f"a <{tag}> cannot stand in a tendon. Available: geom, joint, pulley, site")
    needed = {"joint": ("joint", "coef"), "pulley": ("divisor",)}.get(tag, (tag,))
    missing = [k for k in needed if attrs.get(k) is None]
    if missing:
        raise UsageError(f"a <{tag}> of a tendon needs {' and '.join(missing)}", hint=f"add({tag!r}, {missing[0]}=...)")
    values = {k: v for k, v in attrs.items() if v is not None}
    for key in NAMING[tag]:
        if isinstance(values.get(key), str):
            values[key] = model.find(KIND[key], values[key]) or values[key]
    return PathPart(tag, values, {})


def wrap(tendon: Native, part: PathPart, name: Callable[[str, Handle | str], str]) -> None:
    """Let the path of a tendon of an ``MjSpec`` run on over a part.

    Args:
        name: Kind, and element or text -> the name in that ``MjSpec``.
    """
    names = {key: name(KIND[key], part.values[key]) for key in NAMING[part.tag] if key in part.values}
    if part.tag == "joint":
        tendon.wrap_joint(names["joint"], part.values["coef"])
    elif part.tag == "site":
        tendon.wrap_site(names["site"])
    elif part.tag == "geom":
        tendon.wrap_geom(names["geom"], names.get("sidesite", ""))
    else:
        tendon.wrap_pulley(part.values["divisor"])
