"""Calls hooks once, while a program is traced; refuses actions that tracing would freeze or cannot do."""

from __future__ import annotations

import contextlib
import functools
import io
import pickle
import random
import traceback
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.errors
import numpy as np
from jax.core import Tracer

from sim2real.composer.define import cached_property
from sim2real.composer.hooks import Hooks
from sim2real.composer.physics.mjx.physics import SET_BEFORE
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.types import PyTree

T = TypeVar("T")

_KEEP = "keep what changes in physics.variables[{name!r}], which belongs to each copy; set what does not in __init__"
_LIBRARIES = ("sim2real", "mujoco", "jax", "jaxlib", "dm_env", "brax", "functools", "weakref")
_UNKNOWN = "while the program is made, values of the simulation do not exist"
_WORDS: tuple[tuple[type[Exception], str, str, str], ...] = (
    (
        jax.errors.TracerBoolConversionError,
        "decides in Python (if, and, or, while, assert) on a value of the simulation",
        _UNKNOWN,
        "use physics.np.where(condition, a, b); a start is given up with physics.fail(condition)",
    ),
    (
        jax.errors.TracerArrayConversionError,
        "calls numpy on a value of the simulation",
        _UNKNOWN,
        "use physics.np, which is numpy on the C engine and jax.numpy here",
    ),
    (
        jax.errors.TracerIntegerConversionError,
        "uses a value of the simulation as a Python integer, as in range(n) or items[n]",
        _UNKNOWN,
        "use physics.np.asarray(items)[n]",
    ),
    (
        jax.errors.NonConcreteBooleanIndexError,
        "picks items with a mask",
        "their number does not exist while the program is made",
        "use physics.np.where(mask, values, 0)",
    ),
    (
        jax.errors.ConcretizationTypeError,
        "makes a Python number of a value of the simulation, as float(), int() and .item() do",
        _UNKNOWN,
        "leave it an array",
    ),
    (
        jax.errors.UnexpectedTracerError,
        "uses a value that only existed in an earlier program",
        "it was left in a variable of Python's",
        "keep values from hook to hook in physics.variables",
    ),
    (
        TypeError,
        "writes into an array in place",
        "arrays of compiled programs cannot be written into",
        "use physics.write(element, 'qpos', value, index), or array = array.at[index].set(value)",
    ),
    (
        ValueError,
        "writes into an array of the compiled model",
        "it is one of the program's constants",
        SET_BEFORE,
    ),
)
"""Error of JAX -> action of the hook, why it fails, what to do instead."""
_IN_TEXT = {TypeError: "item assignment", ValueError: "read-only"}
"""Words in the text of the errors of JAX that are meant."""


@contextlib.contextmanager
def named(label: str) -> Iterator[None]:
    """Convert errors of JAX in a block to errors that name the hook and its mistake."""
    try:
        yield
    except Exception as error:
        for kind, what, why, hint in _WORDS:
            if isinstance(error, kind) and _IN_TEXT.get(kind, "") in str(error):
                raise UsageError(f"{label} {what}{_line(error)}: {why}", hint=hint) from error
        raise


def _line(error: Exception) -> str:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "site-packages" not in f.filename]
    user_frames = [f for f in frames if "/sim2real/composer/" not in f.filename.replace("\\", "/")]
    return f" (line {user_frames[-1].lineno}: {user_frames[-1].line})" if user_frames else ""


class TracedHooks(Hooks):
    """Hooks that are called while programs are traced.

    Attributes:
        watched: Objects whose attributes hooks must not change.
    """

    watched: tuple[object, ...] = ()

    def call(self, label: str, function: Callable[..., T], *args: PyTree) -> T:
        """Call a hook, and refuse forbidden changes."""
        before = [_attributes(owner) for owner in self.watched]
        drawn = _drawn() if self.watched else None
        with named(label):
            result = function(*args)
        for owner, values in zip(self.watched, before, strict=True):
            _compare(label, owner, values, _attributes(owner))
        if self.watched and _drawn() != drawn:
            raise UsageError(
                f"{label} draws from a global source of randomness: every episode would get the same numbers",
                hint="draw from random_state",
            )
        return result

    @contextlib.contextmanager
    def watching(self, owners: Iterable[object]) -> Iterator[None]:
        """Refuse changes of some objects' attributes in a ``with`` block; if it fails, restore them."""
        self.watched = tuple(owners)
        before = [dict(vars(owner)) for owner in self.watched]
        try:
            yield
        except Exception:
            for owner, values in zip(self.watched, before, strict=True):
                vars(owner).clear()
                vars(owner).update(values)
            raise
        finally:
            self.watched = ()


def _compare(label: str, owner: object, before: dict[str, object], after: dict[str, object]) -> None:
    """Refuse changes of attributes; absent ones and None may be set, except to traced values."""
    for name in sorted({*before, *after}):
        old, new = before.get(name, _fingerprint(None)), after.get(name, _fingerprint(None))
        what = f"{type(owner).__name__}.{name}"
        if old == new:
            continue
        if _has_tracer(vars(owner).get(name)):
            raise UsageError(
                f"{what} was set by a hook, {label}, to a value that exists only in the program",
                hint=f"keep it in physics.variables[{name!r}]: it then belongs to each copy",
            )
        if old != _fingerprint(None):
            raise UsageError(
                f"{what} is changed by {label}. Hooks run once, while the program is made: "
                "every copy and every step would see the same value",
                hint=_KEEP.format(name=name),
            )


def _attributes(owner: object) -> dict[str, object]:
    return {k: _fingerprint(v) for k, v in vars(owner).items() if not _is_cache(type(owner), k)}


def _is_cache(owner: type, name: str) -> bool:
    return isinstance(getattr(owner, name, None), functools.cached_property | cached_property)


class _Fingerprint(pickle.Pickler):
    """Pickles containers, arrays and the program's own objects by contents, other objects by identity."""

    def persistent_id(self, value: object) -> int | None:
        package = type(value).__module__.partition(".")[0]
        by_identity = package in _LIBRARIES or isinstance(value, type) or callable(value)
        return id(value) if by_identity else None


def _fingerprint(value: object) -> bytes | int:
    """Return a fingerprint of a value's contents; its identity if the contents cannot be read."""
    file = io.BytesIO()
    try:
        _Fingerprint(file, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    except Exception:  # locks and open files do not belong to the simulation
        return id(value)
    return file.getvalue()


def _has_tracer(value: object) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree_util.tree_leaves(value))


def _drawn() -> object:
    return _fingerprint((np.random.get_state(), random.getstate()))


def check_variables(before: dict[str, PyTree], after: dict[str, PyTree]) -> None:
    """Raise a UsageError if a step changes the size of a variable of the task."""
    for name, value in before.items():
        old, new = (
            [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree_util.tree_leaves(v)] for v in (value, after[name])
        )
        if old != new:
            (shape, dtype), (shape_after, dtype_after) = next(p for p in zip(old, new, strict=False) if p[0] != p[1])
            raise UsageError(
                f"physics.variables[{name!r}] starts as {dtype}{list(shape)} and is {dtype_after}{list(shape_after)} "
                "after a step",
                hint="start it with its later shape and type, such as physics.np.zeros(3)",
            )
