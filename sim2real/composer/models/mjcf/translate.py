"""Attributes as MJCF spells them, put on the elements of an ``MjSpec``."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec, Native, Value

mj: Any = mujoco

TREE_KINDS = ("body", "geom", "joint", "site", "camera", "light")
"""Kinds of elements of a body."""

_ORIENTATIONS = {
    "euler": mj.mjtOrientation.mjORIENTATION_EULER,
    "axisangle": mj.mjtOrientation.mjORIENTATION_AXISANGLE,
    "xyaxes": mj.mjtOrientation.mjORIENTATION_XYAXES,
    "zaxis": mj.mjtOrientation.mjORIENTATION_ZAXIS,
}
ORIENTATIONS = frozenset(_ORIENTATIONS)
"""Attributes that say how something is turned, besides ``quat``."""
_RENAMED = {
    "geom": {"mesh": "meshname", "hfield": "hfieldname", "fluidcoef": "fluid_coefs"},
    "joint": {
        "solreflimit": "solref_limit",
        "solimplimit": "solimp_limit",
        "solreffriction": "solref_friction",
        "solimpfriction": "solimp_friction",
        "actuatorfrcrange": "actfrcrange",
        "actuatorfrclimited": "actfrclimited",
        "actuatorgravcomp": "actgravcomp",
    },
    "site": {"mesh": "meshname"},
    "camera": {"target": "targetbody"},
    "light": {"target": "targetbody"},
    "tendon": {
        "solreflimit": "solref_limit",
        "solimplimit": "solimp_limit",
        "solreffriction": "solref_friction",
        "solimpfriction": "solimp_friction",
        "actuatorfrcrange": "actfrcrange",
        "actuatorfrclimited": "actfrclimited",
    },
    "inertial": {"pos": "ipos", "quat": "iquat", "diaginertia": "inertia"},
    "equality": {"body1": "name1", "body2": "name2", "joint1": "name1", "joint2": "name2"},
    "sensor": dict.fromkeys(("site", "joint", "body", "actuator", "tendon", "camera"), "objname"),
    "pair": {"geom1": "geomname1", "geom2": "geomname2"},
    "exclude": {"body1": "bodyname1", "body2": "bodyname2"},
}
_LIMITED = {"false": 0, "true": 1, "auto": 2}
_TRACKING = {
    name: getattr(mj.mjtCamLight, f"mjCAMLIGHT_{name.upper()}")
    for name in ("fixed", "track", "trackcom", "targetbody", "targetbodycom")
}
_ENUMS: dict[tuple[str, str], dict[str, Value]] = {
    ("geom", "type"): {
        name: getattr(mj.mjtGeom, f"mjGEOM_{name.upper()}")
        for name in ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
    },
    ("joint", "type"): {
        name: getattr(mj.mjtJoint, f"mjJNT_{name.upper()}") for name in ("free", "ball", "slide", "hinge")
    },
    ("camera", "mode"): _TRACKING,
    ("light", "mode"): _TRACKING,
}
_ENUMS["site", "type"] = _ENUMS["geom", "type"]
_SECTIONS = {
    **dict.fromkeys(("mesh", "material", "texture", "hfield", "skin"), "asset"),
    **dict.fromkeys(("pair", "exclude"), "contact"),
    **dict.fromkeys(("numeric", "text", "tuple"), "custom"),
    "key": "keyframe",
}
_VECTORS = ("MjDoubleVec", "MjFloatVec")
_SKIPPED = {
    "id",
    "signature",
    "compiler",
    "name",
    "alt",
    "ialt",
    "plugin",
    "parent",
    "frame",
    "classname",
    "path",
    "info",
}


def native_name(kind: str, key: str) -> str:
    """Return the ``MjSpec`` spelling of an MJCF attribute."""
    key = "userdata" if key == "user" else key
    return _RENAMED.get(kind, {}).get(key, key)


def read(native: Native, kind: str, key: str) -> Value:
    """Return an attribute of an element; AttributeError when there is none of that name."""
    if key in _ORIENTATIONS and hasattr(native, "alt"):
        return np.array(getattr(native.alt, key))
    value = getattr(native, native_name(kind, key))
    names = _ENUMS.get((kind, key))
    if names is not None:
        return next((name for name, number in names.items() if number == value), value)
    if kind == "body" and key == "mocap":
        return "true" if value else "false"
    return value


def is_plain(native: Native, kind: str, key: str, value: Value) -> bool:
    """Return whether a value can be put where the ``MjSpec`` holds an attribute, without MuJoCo's parser."""
    plain = _PLAIN.get((kind, key))
    if plain is None:
        plain = _PLAIN[kind, key] = _is_plain(native, kind, key)
    return plain[isinstance(value, str)]


_PLAIN: dict[tuple[str, str], tuple[bool, bool]] = {}
"""Kind and attribute -> whether a value can be put there: one that is no text, one that is."""


def _is_plain(native: Native, kind: str, key: str) -> tuple[bool, bool]:
    if key in _ORIENTATIONS and hasattr(native, "alt"):
        return True, True
    name = native_name(kind, key)
    if name in _SKIPPED or not hasattr(native, name) or (kind, key) == ("numeric", "data"):  # whose length is its size
        return False, False
    value = getattr(native, name)
    is_keyword = type(value).__module__.endswith("_enums") and not isinstance(value, mj.mjtLimited)
    return True, not is_keyword or (kind, key) in _ENUMS


def reset(native: Native, source: Native, names: tuple[str, ...] | None = None) -> None:
    """Put attributes of an element back to those of another one, its defaults; default: all but its name.

    Args:
        names: The attributes, in the spelling of ``MjSpec``; default: all but the name.
    """
    for name in attributes(native) if names is None else names:
        if name in _ORIENTATIONS:
            native.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
        elif not callable(getattr(source, name)):
            setattr(native, name, _detached(getattr(source, name)))
    if names is None and hasattr(native, "alt"):
        native.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT


@functools.cache
def blank(kind: str) -> Native:
    """Return an element of a kind as MuJoCo makes it."""
    spec = mj.MjSpec()
    kind = "body" if kind == "inertial" else kind
    _BLANKS.append(spec)  # which owns the element
    return getattr(spec.worldbody if kind in TREE_KINDS else spec, f"add_{kind}")()


_BLANKS: list[MjSpec] = []


def class_defaults(native: Native, kind: str) -> Native:
    """Return what holds the defaults of an element's class."""
    defaults = getattr(getattr(native, "classname", None), kind, None)
    return blank(kind) if defaults is None else defaults


def assign(native: Native, kind: str, key: str, value: Value) -> None:
    """Set an attribute of an element.

    Args:
        value: Numbers, keywords or text, as in MJCF.

    Raises:
        AttributeError: When elements of this kind have no such attribute.
    """
    plan = _PLANS.get((kind, key))
    if plan is None:
        plan = _PLANS[kind, key] = _plan(native, kind, key)
    name, size, dtype, choices = plan
    if size:
        numbers = np.array(value, dtype) if value.__class__ is not str else np.array(_numbers(value), dtype)
        if numbers.size > size:
            raise UsageError(f"{key} of a <{kind}> takes no more than {size} numbers, got {numbers.size}")
        if numbers.size < size:  # a part is given: the rest stays
            whole = getattr(native, name).copy()
            whole[: numbers.size] = numbers
            numbers = whole
        if name == "quat":
            native.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
        setattr(native, name, numbers)
    elif name in _ORIENTATIONS:
        setattr(native.alt, name, np.asarray(_numbers(value), float))
        native.alt.type = _ORIENTATIONS[name]
    elif choices is not None and isinstance(value, str):
        if value not in choices:
            raise UsageError(f"{key}={value!r} is not valid for <{kind}>. Available: {', '.join(choices)}")
        setattr(native, name, choices[value])
    else:
        setattr(native, name, like(getattr(native, name), value))


_PLANS: dict[tuple[str, str], tuple[str, int, Value, dict[str, Value] | None]] = {}


def _plan(native: Native, kind: str, key: str) -> tuple[str, int, Value, dict[str, Value] | None]:
    """Return the native name of an attribute, length and dtype where it is an array, and names of its values."""
    if key in _ORIENTATIONS and hasattr(native, "alt"):
        return key, 0, None, None
    name = native_name(kind, key)
    if name in _SKIPPED or not hasattr(native, name):
        available = ", ".join(attributes(native))
        raise AttributeError(f"{key!r} is not a valid attribute for <{kind}>. Available: {available}")
    value = getattr(native, name)
    is_array = isinstance(value, np.ndarray) and value.ndim == 1
    return name, value.size if is_array else 0, value.dtype if is_array else None, _ENUMS.get((kind, key))


def like(current: Value, value: Value) -> Value:
    """Return a value in the form that a native attribute takes: padded, parsed, counted."""
    if isinstance(current, mj.mjtLimited):
        return _LIMITED[value] if isinstance(value, str) else int(value)
    if isinstance(current, bool):
        return value == "true" if isinstance(value, str) else bool(value)
    if isinstance(current, np.ndarray):
        numbers = np.atleast_1d(np.asarray(_numbers(value), current.dtype)).ravel()
        if current.ndim == 1 and numbers.size < current.size:
            numbers = np.concatenate([numbers, current[numbers.size :]])
        return numbers
    if isinstance(current, int | float) and isinstance(value, str):
        return type(current)(float(value))
    if type(current).__name__ in _VECTORS:
        return [float(v) for v in np.ravel(_numbers(value))]
    return value


def _numbers(value: Value) -> Value:
    return [float(word) for word in value.split()] if isinstance(value, str) else value


def attributes(native: Native) -> tuple[str, ...]:
    """Return the names of an element's plain attributes."""
    return _attributes(type(native))


@functools.cache
def _attributes(native_type: type) -> tuple[str, ...]:
    names = (n for n in dir(native_type) if not n.startswith("_") and n not in _SKIPPED)
    return tuple(n for n in names if isinstance(getattr(native_type, n), property))


def _text(value: Value) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    array = np.asarray(value)
    if array.dtype == bool:
        return " ".join(str(v).lower() for v in array.ravel().tolist())
    return " ".join(repr(v) for v in array.ravel().tolist())


def from_xml(
    kind: str, tag: str, attrs: Mapping[str, Value], references: Iterable[str]
) -> tuple[Mapping[str, Value], dict[str, Value]]:
    """Return the native attributes that MuJoCo's own parser reads from MJCF: plain ones, and those that name elements.

    Args:
        references: Attributes in ``attrs`` that name other elements.

    Raises:
        ValueError: When the parser refuses the element.
    """
    if kind == "tuple":  # which has no attributes; its references are added later
        return {}, {}
    plain = tuple([(k, v if v.__class__ is str else _text(v)) for k, v in attrs.items() if k not in references])
    fixed, named = _parsed(kind, tag, plain, tuple(references))
    return fixed, {
        name: [attrs.get(v[1:], v) for v in value] if isinstance(value, list) else attrs[value[1:]]
        for name, value in named.items()
    }


@functools.lru_cache(maxsize=4096)
def _parsed(
    kind: str, tag: str, plain: tuple[tuple[str, str], ...], references: tuple[str, ...]
) -> tuple[dict[str, Value], dict[str, Value]]:
    needed = (("name", "_"),) if kind in ("numeric", "text") else ()
    words = " ".join(f"{k}={quoteattr(v)}" for k, v in (*needed, *plain, *((k, f"@{k}") for k in references)))
    spec = mj.MjSpec()
    if kind in TREE_KINDS:
        text, owner = f"<worldbody><body><{tag} {words}/></body></worldbody>", spec.worldbody
    else:
        section = _SECTIONS.get(kind, kind)
        text, owner = f"<{section}><{tag} {words}/></{section}>", spec
    source = getattr(mj.MjSpec.from_string(f"<mujoco>{text}</mujoco>"), plural(kind))[2 if kind == "body" else 0]
    fresh = getattr(owner, f"add_{kind}")()
    explicit = {native_name(kind, k) for k, _ in plain}
    fixed, named = {}, {}
    for name in _attributes(type(source)):
        value = getattr(source, name)
        if name in explicit or not same(value, getattr(fresh, name)):
            value = _detached(value)
            (named if _is_reference(value) else fixed)[name] = value
    return fixed, named


def key_of(kind: str, tag: str, name: str, references: tuple[str, ...], plain: Mapping[str, str]) -> str | None:
    """Return the native attribute, such as ``objname`` or ``textures[1]``, that MuJoCo's parser puts a reference in."""
    try:
        _, named = _parsed(kind, tag, tuple(plain.items()), references)
    except ValueError:
        return None
    for key, value in named.items():
        if value == f"@{name}":
            return key
        if isinstance(value, list) and f"@{name}" in value:
            return f"{key}[{value.index(f'@{name}')}]"
    return None


def _is_reference(value: Value) -> bool:
    """Return whether a parsed value is a placeholder, or a list with one."""
    if isinstance(value, list):
        value = next((v for v in value if v), "")
        return isinstance(value, str) and value[:1] == "@"
    return isinstance(value, str) and value[:1] == "@"


def _detached(value: Value) -> Value:
    """Return a value that outlives the spec it was read from."""
    if isinstance(value, np.ndarray):
        return value.copy()
    return list(value) if type(value).__name__.endswith("Vec") else value


def same(a: Value, b: Value) -> bool:
    """Return whether two native values are equal."""
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, str | bool | int | float) or hasattr(a, "value"):
        return a == b or a != a
    try:
        return list(a) == list(b)
    except TypeError:
        return True


def kind_of(native: Native) -> str:
    """Return the kind of an element of an ``MjSpec``."""
    return type(native).__name__.removeprefix("Mjs").lower()


def plural(kind: str) -> str:
    """Return the name of the list in an ``MjSpec`` that holds elements of a kind."""
    if kind == "body":
        return "bodies"
    if kind == "equality":
        return "equalities"
    return f"{kind}es" if kind in ("mesh", "flex") else f"{kind}s"
