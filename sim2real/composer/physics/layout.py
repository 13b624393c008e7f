"""Indices of the attributes of elements in MuJoCo's arrays, for both engines."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mujoco.introspect.ast_nodes import StructFieldDecl
from mujoco.introspect.structs import STRUCTS

from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import Index, MjModel

TRIGGERS = {"qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat", "eq_active"}
"""Fields of the data from which other quantities are computed."""
_COSMETIC = ("rgba", "matid", "emission", "specular", "shininess", "reflectance", "needstage", "user", "group")

DISABLED_BY = {
    "body_pos": ("body_sameframe",),
    "body_quat": ("body_sameframe",),
    "geom_pos": ("geom_sameframe",),
    "geom_quat": ("geom_sameframe",),
    "site_pos": ("site_sameframe",),
    "site_quat": ("site_sameframe",),
    "body_ipos": ("body_simple", "body_sameframe"),
    "body_iquat": ("body_simple", "body_sameframe"),
}
"""MuJoCo's shortcuts that must be switched off when a field is written, because they would ignore the new value."""


COLUMNS = {
    **{name: i for i, name in enumerate(("x", "y", "z"))},
    **{name: i for i, name in enumerate(("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"))},
    **{name: i for i, name in enumerate(("qw", "qx", "qy", "qz"))},
    **{name: i for i, name in enumerate("rgba")},
}
"""Names of the columns of vectors, matrices, quaternions and colours."""


def columns(key: Index) -> Index:
    """Return the numbers of columns for a name such as ``'x'``, or for a list or an array of names."""
    if isinstance(key, str):
        if key not in COLUMNS:
            raise KeyError(f"there is no column {key!r}. Available: {', '.join(COLUMNS)}")
        return COLUMNS[key]
    if isinstance(key, list | tuple | np.ndarray):
        array = np.asarray(key)
        if array.dtype.kind == "U":
            return np.array([columns(k) if isinstance(k, str) else k for k in np.ravel(key)]).reshape(array.shape)
        return array
    return key


@dataclass(frozen=True)
class ElementKind:
    """Storage of elements of a kind: object type, first dimensions of fields, prefixes of field names."""

    object_type: int
    sizes: tuple[str, ...]
    prefixes: tuple[str, ...]


KINDS = {
    "body": ElementKind(mj.mjtObj.mjOBJ_BODY, ("nbody", "nmocap"), ("body",)),
    "joint": ElementKind(mj.mjtObj.mjOBJ_JOINT, ("nq", "nv", "njnt"), ("jnt", "dof")),
    "geom": ElementKind(mj.mjtObj.mjOBJ_GEOM, ("ngeom",), ("geom",)),
    "site": ElementKind(mj.mjtObj.mjOBJ_SITE, ("nsite",), ("site",)),
    "camera": ElementKind(mj.mjtObj.mjOBJ_CAMERA, ("ncam",), ("cam",)),
    "light": ElementKind(mj.mjtObj.mjOBJ_LIGHT, ("nlight",), ("light",)),
    "actuator": ElementKind(mj.mjtObj.mjOBJ_ACTUATOR, ("na", "nu", "nactuator", "nout"), ("actuator",)),
    "sensor": ElementKind(mj.mjtObj.mjOBJ_SENSOR, ("nsensor", "nsensordata"), ("sensor",)),
    "tendon": ElementKind(mj.mjtObj.mjOBJ_TENDON, ("ntendon",), ("tendon", "ten")),
    "equality": ElementKind(mj.mjtObj.mjOBJ_EQUALITY, ("neq",), ("eq",)),
    "mesh": ElementKind(mj.mjtObj.mjOBJ_MESH, ("nmesh",), ("mesh",)),
    "hfield": ElementKind(mj.mjtObj.mjOBJ_HFIELD, ("nhfield",), ("hfield",)),
    "material": ElementKind(mj.mjtObj.mjOBJ_MATERIAL, ("nmat",), ("mat",)),
    "texture": ElementKind(mj.mjtObj.mjOBJ_TEXTURE, ("ntex",), ("tex",)),
    "numeric": ElementKind(mj.mjtObj.mjOBJ_NUMERIC, ("nnumeric", "nnumericdata"), ("numeric",)),
    "text": ElementKind(mj.mjtObj.mjOBJ_TEXT, ("ntext",), ("text",)),
    "key": ElementKind(mj.mjtObj.mjOBJ_KEY, ("nkey",), ("key",)),
}
OBJECT_TYPES = {
    **{name: kind.object_type for name, kind in KINDS.items()},
    **{name: getattr(mj.mjtObj, f"mjOBJ_{name.upper()}") for name in ("pair", "exclude", "tuple", "skin", "flex")},
}


@dataclass(frozen=True)
class Field:
    """One array of mjModel or mjData: the struct, its name, its first dimension."""

    struct: str
    name: str
    size: str

    @property
    def triggers(self) -> bool:
        """Whether writing it makes derived quantities out of date."""
        if self.struct == "data":
            return self.name in TRIGGERS
        return not self.name.endswith(_COSMETIC)


@functools.cache
def array_fields(struct: str) -> dict[str, Field]:
    """Return the arrays of ``model`` or ``data`` by name."""
    fields = STRUCTS["mjModel" if struct == "model" else "mjData"].fields
    extents = ((f.name, f.array_extent) for f in fields if isinstance(f, StructFieldDecl))
    return {name: Field(struct, name, str(extent[0])) for name, extent in extents if extent}


@functools.cache
def attributes(kind: str) -> dict[str, Field]:
    """Return attribute -> field for elements of a kind, such as ``damping`` -> ``dof_damping`` for joints."""
    try:
        sizes, prefixes = KINDS[kind].sizes, KINDS[kind].prefixes
    except KeyError:
        raise UsageError(f"elements of kind {kind!r} cannot be bound. Available: {', '.join(KINDS)}") from None
    prefix = re.compile(rf"\A({'|'.join(prefixes)})_")
    fields = [f for struct in ("data", "model") for f in array_fields(struct).values() if f.size in sizes]
    return {prefix.sub("", f.name): f for f in fields}


_RANGES = {
    "nv": ("jnt_dofadr", None),
    "nq": ("jnt_qposadr", None),
    "na": ("actuator_actadr", "actuator_actnum"),
    "nu": ("actuator_ctrladr", "actuator_ctrlnum"),
    "nout": ("actuator_outadr", "actuator_outnum"),
    "nsensordata": ("sensor_adr", "sensor_dim"),
    "nnumericdata": ("numeric_adr", "numeric_size"),
}
_JOINT_WIDTH = {"nq": (7, 4, 1, 1), "nv": (6, 3, 1, 1)}
_ALWAYS_RANGES = ("nq", "nv", "nsensordata", "nnumericdata")


def _range(model: MjModel, size: str, number: int) -> range:
    start_field, count_field = _RANGES[size]
    start = int(getattr(model, start_field)[number])
    if count_field is None:
        return range(start, start + _JOINT_WIDTH[size][int(model.jnt_type[number])])
    return range(start, start + int(getattr(model, count_field)[number])) if start >= 0 else range(0)


def index(model: MjModel, field: Field, ids: tuple[int, ...], single: bool) -> Any:
    """Return the index of the rows of a field: an int, a slice, or an int array of shape ``(n,)``.

    Args:
        single: Whether one element was bound, rather than a sequence of them.
    """
    if field.size == "nmocap":
        rows = [int(model.body_mocapid[i]) for i in ids]
    elif field.size in _RANGES:
        ranges = [_range(model, field.size, i) for i in ids]
        if single and (field.size in _ALWAYS_RANGES or len(ranges[0]) != 1):
            return slice(ranges[0].start, ranges[0].stop)
        rows = [row for r in ranges for row in r]
    else:
        rows = list(ids)
    return rows[0] if single else np.array(rows, dtype=int)


def resolve(model: MjModel, kind: str, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the numbers of elements in a compiled model."""
    object_type = OBJECT_TYPES[kind]
    numbers = tuple(mj.mj_name2id(model, object_type, name) for name in names)
    if -1 in numbers:
        available = names_of(model, kind)
        raise UsageError(
            f"the compiled model has no {kind} {names[numbers.index(-1)]!r}. Available: {', '.join(available)}",
            hint="elements that were added after the compilation exist only after the next one",
        )
    return numbers


def names_of(model: MjModel, kind: str) -> list[str]:
    """Return the names of all elements of a kind in a compiled model, '' for elements without a name."""
    object_type = OBJECT_TYPES[kind]
    count = {"camera": "ncam", "joint": "njnt", "material": "nmat", "texture": "ntex", "equality": "neq"}.get(kind)
    count = count or {"actuator": "nactuator"}.get(kind) or f"n{kind}"
    return [mj.mj_id2name(model, object_type, i) or "" for i in range(getattr(model, count))]
