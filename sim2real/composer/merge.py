"""Options of attached models: those that only one model sets hold for all; contradictions are errors.

A field counts as set when it differs from MuJoCo's default. Sizes take the largest, tolerances the smallest value.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

import numpy as np

from sim2real.composer.translate import mj
from sim2real.errors import UsageError

Settings = dict[tuple[str, str], Any]

_SMALLEST = {"timestep", "tolerance", "ls_tolerance", "noslip_tolerance", "ccd_tolerance", "znear"}
_LARGEST = {
    *("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations", "sdf_initpoints"),
    *("zfar", "njmax", "nconmax", "nstack", "memory", "nuserdata", "nkey"),
}
_BITS = {"disableflags", "enableflags", "disableactuator"}
_PARTS = (
    "option",
    "stat",
    *(f"visual.{name}" for name in ("global_", "quality", "headlight", "map", "scale", "rgba")),
)
_SIZES = ("njmax", "nconmax", "nstack", "memory", "nuserdata", "nkey")


def _part(spec: Any, path: str) -> Any:
    for step in path.split(".") if path else ():
        spec = getattr(spec, step)
    return spec


@functools.cache
def _defaults() -> dict[str, dict[str, tuple[Any, Any]]]:
    """Return part -> field -> MuJoCo's default, and what compares fastest with it."""
    blank, found = mj.MjSpec(), {}
    for path in _PARTS:
        part = _part(blank, path)
        values = {name: getattr(part, name) for name in dir(part) if not name.startswith("_")}
        found[path] = {k: _entry(v) for k, v in values.items() if isinstance(v, int | float | np.ndarray)}
    found[""] = {name: _entry(getattr(blank, name)) for name in _SIZES}
    return found


def _entry(value: Any) -> tuple[Any, Any]:
    return (value.copy(), value.tobytes()) if isinstance(value, np.ndarray) else (value, value)


def _differ(a: Any, b: Any) -> bool:
    return a.tobytes() != b.tobytes() if isinstance(a, np.ndarray) else a != b


def settings(spec: Any) -> Settings:
    """Return what a spec sets, rather than leaving it at MuJoCo's default: (part, field) -> value."""
    found: Settings = {}
    for path, fields in _defaults().items():
        part = _part(spec, path)
        for name, (default, quick) in fields.items():
            value = getattr(part, name)
            if isinstance(value, np.ndarray):
                if value.tobytes() != quick:
                    found[path, name] = value.copy()
            elif value != default and (value == value or default == default):
                found[path, name] = value
    return found


def merged(models: Iterable[Any]) -> Settings:
    """Return what holds in a world of these models.

    Raises:
        UsageError: When two of them contradict each other, with the attribute, both values and both models.
    """
    found: Settings = {}
    owner: dict[tuple[str, str], str] = {}
    for model in models:
        for key, value in model.settings().items():
            mine, name = found.get(key, value), key[1]
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
                    hint="set it in one of the two models only, or to the same value in both",
                )
            found[key] = value
            owner.setdefault(key, model.model)
    return found


def clear(spec: Any, found: Settings) -> None:
    """Put settings back to MuJoCo's defaults, in a copy that is about to become a part of another spec."""
    for path, name in found:
        setattr(_part(spec, path), name, _defaults()[path][name][0])


def apply(spec: Any, found: Settings) -> None:
    """Set settings."""
    for (path, name), value in found.items():
        setattr(_part(spec, path), name, value)


_INHERITED = ("boundmass", "boundinertia", "balanceinertia", "inertiafromgeom", "autolimits", "alignfree", "fitaabb")
"""Settings of the compiler that hold for attached models too, unless they have their own."""


def inherit_compiler(spec: Any, model: Any) -> None:
    """Give a copy of a model's spec the settings of the compiler that the models above have and it has not."""
    default = _blank().compiler
    for name in _INHERITED:
        above = model.parent_model
        while above is not None and getattr(spec.compiler, name) == getattr(default, name):
            setattr(spec.compiler, name, getattr(above._spec.compiler, name))
            above = above.parent_model


@functools.cache
def _blank() -> Any:
    return mj.MjSpec()
