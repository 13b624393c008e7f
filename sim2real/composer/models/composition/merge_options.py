"""Options of attached models: those that only one model sets hold for all; contradictions are errors.

A field counts as set when a document or a program wrote it, or when it differs from MuJoCo's default. Sizes take the
largest, tolerances the smallest value. A setting that is written after models were attached takes precedence over the
settings of those models.
"""

from __future__ import annotations

import functools
import itertools
import weakref
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from mujoco.introspect.structs import STRUCTS

from sim2real.composer.models.mjcf.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sim2real.composer.types import MjSpec, Value

Settings: TypeAlias = "dict[tuple[str, str], Value]"

_SMALLEST = {"timestep", "tolerance", "ls_tolerance", "noslip_tolerance", "ccd_tolerance", "znear"}
_LARGEST = {
    *("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations", "sdf_initpoints"),
    *("zfar", "njmax", "nconmax", "nstack", "memory", "nuserdata", "nkey"),
}
_BITS = {"disableactuator"}
_VISUAL = ("global_", "quality", "headlight", "map", "scale", "rgba")
PARTS = ("option", "stat", *(f"visual.{name}" for name in _VISUAL))
_SIZES = ("njmax", "nconmax", "nstack", "memory", "nuserdata", "nkey")
FLAG = "option.flag"
FLAGS: dict[str, tuple[str, int]] = {
    name[7:].lower(): (field, int(bit))
    for field, kind, prefix in (
        ("disableflags", mj.mjtDisableBit, "mjDSBL_"),
        ("enableflags", mj.mjtEnableBit, "mjENBL_"),
    )
    for name, bit in kind.__members__.items()
    if name.startswith(prefix)
}
"""Name of a flag in MJCF -> field of the options and bit."""
_clock = itertools.count()


def _part(spec: MjSpec, path: str) -> Value:
    for step in path.split(".") if path else ():
        spec = getattr(spec, step)
    return spec


@functools.cache
def _defaults() -> dict[str, dict[str, tuple[Value, Value]]]:
    """Return part -> field -> MuJoCo's default, and what compares fastest with it."""
    blank, defaults = mj.MjSpec(), {}
    for path in PARTS:
        part = _part(blank, path)
        values = {name: getattr(part, name) for name in dir(part) if not name.startswith("_")}
        defaults[path] = {k: _entry(v) for k, v in values.items() if isinstance(v, int | float | np.ndarray)}
    defaults["option"] = {k: v for k, v in defaults["option"].items() if k not in ("disableflags", "enableflags")}
    defaults[""] = {name: _entry(getattr(blank, name)) for name in _SIZES}
    return defaults


def _entry(value: Value) -> tuple[Value, Value]:
    return (value.copy(), value.tobytes()) if isinstance(value, np.ndarray) else (value, value)


@functools.cache
def _bits() -> dict[str, tuple[str, dict[str, int]]]:
    """Return part -> where MuJoCo notes which of its fields a document wrote, and the bit of each field."""
    structs: dict[str, Value] = {"option": STRUCTS["mjOption"]}
    parts: Value = STRUCTS["mjVisual"].fields
    structs |= {f"visual.{part.name}": part.type for part in parts}
    bits = {}
    for path in PARTS:
        struct = structs.get(path.rstrip("_"))
        if struct is not None:
            bits[path] = path.rstrip("_").replace(".", "_"), {f.name: 1 << i for i, f in enumerate(struct.fields)}
    return bits


def _author(spec: MjSpec, path: str, name: str) -> None:
    """Note that a field was written, with any value."""
    if path == FLAG:
        where, bit = FLAGS[name]
    else:
        where, bits = _bits().get(path, ("", {}))
        bit = bits.get(name, 0)
    if bit:
        setattr(spec.authored, where, getattr(spec.authored, where) | bit)


def _differ(a: Value, b: Value) -> bool:
    return a.tobytes() != b.tobytes() if isinstance(a, np.ndarray) else a != b


def settings(spec: MjSpec) -> Settings:
    """Return what a spec sets: (part, field) -> value; flags are ``enable`` or ``disable``."""
    values: Settings = {}
    written = {path: (getattr(spec.authored, where), bits) for path, (where, bits) in _bits().items()}
    for path, fields in _defaults().items():
        part = _part(spec, path)
        mask, bits = written.get(path, (0, {}))
        for name, (default, quick) in fields.items():
            value = getattr(part, name)
            if isinstance(value, np.ndarray):
                if value.tobytes() != quick or mask & bits.get(name, 0):
                    values[path, name] = value.copy()
            elif (value != default and (value == value or default == default)) or mask & bits.get(name, 0):
                values[path, name] = value
    _add_flags(spec, values)
    return values


def _add_flags(spec: MjSpec, values: Settings) -> None:
    masks = {f: getattr(spec.authored, f) | getattr(spec.option, f) for f in ("disableflags", "enableflags")}
    if any(masks.values()):
        for name, (field, bit) in FLAGS.items():
            if masks[field] & bit:
                raised = bool(getattr(spec.option, field) & bit)
                values[FLAG, name] = "enable" if raised == (field == "enableflags") else "disable"


class Member(Protocol):
    """A model among others: a ``Scope``."""

    overrides: Overrides

    @property
    def _spec(self) -> MjSpec: ...

    @property
    def model(self) -> str:
        """Its name."""
        ...

    @property
    def parent_model(self) -> Member | None:
        """The model that it is attached to."""
        ...

    @property
    def attachments(self) -> Mapping[str, Value]:
        """The attached models, by name."""
        ...

    @property
    def root_model(self) -> Member:
        """The model at the top."""
        ...

    def all_models(self) -> Iterator[Member]:
        """Yield it and all attached to it."""
        ...

    def settings(self) -> Settings:
        """Return its settings."""
        ...

    def touch_settings(self) -> None:
        """Note a change of the options."""


class Overrides:
    """Which settings of a model were written while others were attached: they hold over what those had set."""

    def __init__(self) -> None:
        self._noted: dict[tuple[str, str], tuple[int, weakref.WeakSet[Member]]] = {}

    def note(self, key: tuple[str, str], others: Iterable[Member]) -> None:
        """Note that a setting was written in a world of other models."""
        covered = weakref.WeakSet(others)
        if covered:
            self._noted[key] = next(_clock), covered

    def since(self, key: tuple[str, str]) -> int:
        """Return when a setting was written last in a world; -1: never."""
        return self._noted[key][0] if key in self._noted else -1

    def beats(self, key: tuple[str, str], model: Member) -> bool:
        """Return whether a setting holds over that of another model."""
        when, covered = self._noted.get(key, (-1, ()))
        return model in covered and when > model.overrides.since(key)

    def among(self, twins: Mapping[Value, Value]) -> Overrides:
        """Return the same of a copied model, among the copies of the others: model -> its copy."""
        overrides = Overrides()
        for key, (when, covered) in self._noted.items():
            overrides._noted[key] = when, weakref.WeakSet(twins[m] for m in covered if m in twins)
        return overrides

    def __bool__(self) -> bool:
        return bool(self._noted)


def merged(models: Iterable[Member]) -> Settings:
    """Return what holds in a world of these models."""
    models = list(models)
    later = [m.overrides for m in models if m.overrides]
    values: Settings = {}
    owner: dict[tuple[str, str], str] = {}
    for model in models:
        for key, value in model.settings().items():
            # Skip settings that another model wrote after this one was attached.
            if any(overrides.beats(key, model) for overrides in later):
                continue
            mine, name = values.get(key, value), key[1]
            # Combine the values, or refuse different ones.
            if name in _SMALLEST:
                value = min(mine, value)
            elif name in _LARGEST:
                value = max(mine, value)
            elif name in _BITS:
                value = mine | value
            elif _differ(mine, value):
                raise UsageError(
                    f"Conflicting values for attribute `{'.'.join(filter(None, key))}`: {mine} in model "
                    f"{owner[key]!r}, {value} in model {model.model!r}",
                    hint="set it in one of the two models only, or again after they were attached",
                )
            values[key] = value
            owner.setdefault(key, model.model)
    return values


def note(model: Member, path: str, name: str) -> None:
    """Note that a program wrote a setting of a model: it counts as set, and holds over what attached models had set.

    Args:
        path: Part of the spec, such as ``option`` or ``visual.map``; '' for sizes.
    """
    _author(model._spec, path, name)
    model.overrides.note((path, name), (m for m in model.root_model.all_models() if m is not model))
    model.touch_settings()


def in_world(model: Member, path: str, name: str, value_here: Value) -> Value:
    """Return the value of a setting in the world that a model is a part of, given the model's own.

    Args:
        path: Part of the spec, such as ``option`` or ``visual.map``; '' for sizes.
    """
    if model.parent_model is None and not model.attachments:
        return value_here
    value = merged(model.root_model.all_models()).get((path, name), value_here)
    if not isinstance(value, np.ndarray):
        return value
    if np.array_equal(value, value_here):
        return value_here
    value.flags.writeable = False  # another model's: writing into it would change nothing
    return value


def clear(spec: MjSpec, values: Settings) -> None:
    """Put settings back to MuJoCo's defaults, in a copy that is about to become a part of another spec."""
    for path, name in values:
        if path == FLAG:
            spec.option.disableflags = spec.option.enableflags = 0
        else:
            setattr(_part(spec, path), name, _defaults()[path][name][0])
    for where in ("disableflags", "enableflags", "disableactuator", *(where for where, _ in _bits().values())):
        setattr(spec.authored, where, 0)


def apply(spec: MjSpec, values: Settings) -> None:
    """Set settings."""
    for (path, name), value in values.items():
        if path == FLAG:
            set_flag(spec, name, value)
        else:
            setattr(_part(spec, path), name, value)


def set_flag(spec: MjSpec, name: str, value: str) -> None:
    """Switch a flag: ``enable`` or ``disable``."""
    field, bit = FLAGS[name]
    bits = getattr(spec.option, field)
    raised = (value == "enable") == (field == "enableflags")
    setattr(spec.option, field, bits | bit if raised else bits & ~bit)


_INHERITED = ("boundmass", "boundinertia", "balanceinertia", "inertiafromgeom", "autolimits", "alignfree", "fitaabb")
"""Settings of the compiler that hold for attached models too, unless they have their own."""


def inherit_compiler(spec: MjSpec, model: Member) -> None:
    """Give a copy of a model's spec the settings of the compiler that the models above have and it has not."""
    default = _blank().compiler
    for name in _INHERITED:
        above = model.parent_model
        while above is not None and getattr(spec.compiler, name) == getattr(default, name):
            setattr(spec.compiler, name, getattr(above._spec.compiler, name))
            above = above.parent_model


@functools.cache
def _blank() -> MjSpec:
    return mj.MjSpec()
