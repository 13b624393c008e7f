"""The interface that both engines share: a physics, its model with names, and bound elements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sim2real.composer.mjcf.element import as_elements
from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics import layout
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Elements
    from sim2real.composer.physics.named import Named
    from sim2real.composer.types import ArrayLike, ArrayModule, Index, MjData, MjModel
    from sim2real.types import Array, PyTree


class BasePhysics(ABC):
    """A model and its state; hooks, observables and tasks read and write it on either engine.

    Attributes:
        np: The module of this engine's arrays: ``numpy`` or ``jax.numpy``.
        model: The attributes of an ``MjModel``; ``ptr`` is the compiled model itself.
        data: The attributes of an ``MjData``.
        named: Model and data, with rows by name.
        variables: Name -> array: values that a task stores between hooks of an episode. ``reset`` empties it.
        legacy_step: Whether to compute positions and velocities of the new state after a step, as in dm_control.
    """

    np: ClassVar[ArrayModule]
    model: BaseModelView
    data: PyTree
    named: Named
    variables: dict[str, PyTree]
    legacy_step: bool

    def time(self) -> float | Array:
        """Return the simulated time [s]."""
        return self.data.time

    def timestep(self) -> float | Array:
        """Return the duration of a step [s]."""
        return self.model.opt.timestep

    def control(self) -> Array:
        """Return the controls, shape ``(nu,)``."""
        return self.data.ctrl

    @abstractmethod
    def set_control(self, control: ArrayLike) -> None:
        """Set the controls, shape ``(nu,)`` [the actuators' units]."""

    def position(self) -> Array:
        """Return a copy of qpos, shape ``(nq,)``."""
        return self._copied(self.data.qpos)

    def velocity(self) -> Array:
        """Return a copy of qvel, shape ``(nv,)``."""
        return self._copied(self.data.qvel)

    def activation(self) -> Array:
        """Return a copy of act, shape ``(na,)``."""
        return self._copied(self.data.act)

    @abstractmethod
    def _copied(self, array: PyTree) -> Array:
        """Return an array that later steps do not change."""

    def get_state(self) -> Array:
        """Return positions, velocities and activations, shape ``(nq + nv + na,)``."""
        return self.np.concatenate([self.data.qpos, self.data.qvel, self.data.act])

    state = get_state

    def set_state(self, state: ArrayLike) -> None:
        """Set positions, velocities and activations, shape ``(nq + nv + na,)``.

        Raises:
            UsageError: The shape is another.
        """
        model, xp = self.model.ptr, self.np
        expected = (model.nq + model.nv + model.na,)
        if xp.shape(state) != expected:
            raise UsageError(f"Input physics state has shape {xp.shape(state)}. Expected {expected}.")
        parts = xp.split(xp.asarray(state), [model.nq, model.nq + model.nv])
        for name, part in zip(("qpos", "qvel", "act"), parts, strict=True):
            setattr(self.data, name, part)

    def check_keyframe(self, keyframe_id: int) -> None:
        """Raise UsageError if there is no such keyframe."""
        count = self.model.ptr.nkey
        if not 0 <= keyframe_id < count:
            raise UsageError(f"`keyframe_id` must be between 0 and {count - 1} inclusive, got: {keyframe_id}")

    @abstractmethod
    def reset(self, keyframe_id: int | None = None) -> None:
        """Return to the initial state, or to a keyframe."""

    @abstractmethod
    def step(self) -> None:
        """Advance by a time step."""

    @abstractmethod
    def forward(self) -> None:
        """Compute all quantities that follow from the state, without advancing."""

    @abstractmethod
    def mark_as_dirty(self) -> None:
        """Let all quantities be computed again before a binding reads a derived one."""

    @abstractmethod
    def recompute_constants(self) -> None:
        """Compute the constants that MuJoCo derives from masses and lengths, after these were changed."""

    @abstractmethod
    def fail(self, condition: ArrayLike = True) -> None:
        """Reject this initial state where the condition is true."""

    @abstractmethod
    def suppress_physics_errors(self) -> AbstractContextManager[None]:
        """Log MuJoCo's warnings inside a ``with`` block instead of raising them."""

    def bind(self, elements: Elements) -> PyTree:
        """Return the attributes of an element, or of several of one kind.

        Raises:
            UsageError: Something is no element, is of another kind than the rest, or is not in the compiled model.
        """
        sequence, single = as_elements(elements)
        if not sequence:
            return EmptyBinding()
        kind = sequence[0].kind
        layout.attributes(kind)
        ids = layout.resolve(self.model.ptr, kind, tuple(e.full_identifier for e in sequence))
        return self._new_binding(kind, ids, single)

    @abstractmethod
    def _new_binding(self, kind: str, ids: tuple[int, ...], single: bool) -> BaseBinding:
        """Return a binding of the elements with these numbers."""

    def get(self, elements: Elements, name: str) -> PyTree:
        """Return an attribute of elements."""
        return getattr(self.bind(elements), name)

    def set(self, elements: Elements, name: str, value: ArrayLike) -> Self:
        """Set an attribute of elements and return the physics.

        Args:
            name: The attribute, in MuJoCo's spelling without the kind's prefix.
        """
        setattr(self.bind(elements), name, value)
        return self

    def write(self, elements: Elements, name: str, value: ArrayLike, index: Index) -> Self:
        """Set a part of an attribute of elements, ``attribute[index]``, and return the physics.

        Args:
            name: The attribute, in MuJoCo's spelling without the kind's prefix.
        """
        return self.set(elements, name, updated(self.np, self.get(elements, name), index, value))


class NativeView:
    """The attributes of ``ptr``, an ``MjModel`` or an ``MjData``."""

    __slots__ = ("ptr",)
    ptr: PyTree

    def __init__(self, ptr: MjModel | MjData) -> None:
        object.__setattr__(self, "ptr", ptr)

    def __getattr__(self, name: str) -> PyTree:
        return getattr(self.ptr, name)

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        setattr(self.ptr, name, value)


class BaseModelView(NativeView):
    """``physics.model``: the attributes of an ``MjModel``, and conversions between names and numbers."""

    __slots__ = ()

    def name2id(self, name: str, kind: str | int) -> int:
        """Return the number of a named element of a kind, or ``mjtObj``; raise UsageError if there is none."""
        return layout.resolve(self.ptr, _kind(kind), (name,))[0]

    def id2name(self, number: int, kind: str | int) -> str:
        """Return the name of an element of a kind, or ``mjtObj``; '' if it has none."""
        return mj.mj_id2name(self.ptr, layout.OBJECT_TYPES[_kind(kind)], number) or ""


def _kind(kind: str | int) -> str:
    if isinstance(kind, str):
        return kind
    kinds = {int(number): name for name, number in layout.OBJECT_TYPES.items()}
    if int(kind) not in kinds:
        raise UsageError(f"no elements have the mjtObj {kind}. Available: {', '.join(layout.OBJECT_TYPES)}")
    return kinds[int(kind)]


class BaseBinding(ABC):
    """Elements of one kind in one physics: ``binding.qpos``, ``binding.xpos = ...``, ``binding['pos', [0, 2]]``.

    Attribute names are MuJoCo's without the kind's prefix. One element: a row, shape ``(...)``; several: ``(n, ...)``;
    attributes with several entries per element (``qpos``, ``qvel``, ``sensordata``) are concatenated.

    Args:
        single: Whether one element is bound, rather than a sequence of them.
    """

    __slots__ = ("_fields", "_ids", "_kind", "_physics", "_single", "element_id")
    _fields: dict[str, layout.Field]
    _ids: tuple[int, ...]
    _kind: str
    _physics: BasePhysics
    _single: bool
    element_id: int | np.ndarray

    def __init__(self, physics: BasePhysics, kind: str, ids: tuple[int, ...], single: bool) -> None:
        fields = layout.attributes(kind)
        if kind == "body" and any(physics.model.ptr.body_mocapid[i] < 0 for i in ids):
            fields = {name: field for name, field in fields.items() if field.size != "nmocap"}
        numbers = np.array(ids, int)
        numbers.flags.writeable = False
        values = (fields, ids, kind, physics, single, ids[0] if single else numbers)
        for name, value in zip(BaseBinding.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    def locate(self, name: str) -> tuple[layout.Field, Index]:
        """Return the field with an attribute, and the index of the bound rows in it."""
        field = self._fields.get(name)
        if field is None:
            available = ", ".join(sorted(self._fields))
            message = f"bound element <{self._kind}> does not have attribute {name!r}. Available: {available}"
            raise AttributeError(message)
        return field, layout.index(self._physics.model.ptr, field, self._ids, self._single)

    @abstractmethod
    def read(self, name: str) -> PyTree:
        """Return an attribute of all bound elements."""

    @abstractmethod
    def write(self, name: str, value: ArrayLike) -> None:
        """Set an attribute of all bound elements."""

    def __getattr__(self, name: str) -> PyTree:
        if name.startswith("__"):
            raise AttributeError(name)
        return self.read(name)

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self.write(name, value)

    def __getitem__(self, key: Index) -> PyTree:
        name, axes = key if isinstance(key, tuple) else (key, None)
        return self.read(name) if axes is None else self._plain(self.read(name))[..., layout.columns(axes)]

    def __setitem__(self, key: Index, value: ArrayLike) -> None:
        name, axes = key if isinstance(key, tuple) else (key, None)
        if axes is not None:
            value = updated(self._physics.np, self.read(name), (..., layout.columns(axes)), value)
        self.write(name, value)

    def _plain(self, array: PyTree) -> Array:
        """Return an array that is not bound to the elements."""
        return array

    def __dir__(self) -> list[str]:
        return sorted({*self._fields, "element_id"})


class EmptyBinding:
    """No elements: every attribute is an empty array, and none can be set."""

    __slots__ = ()
    element_id = np.zeros(0, int)

    def free(self) -> None:
        """Do nothing, as there are no arrays to free."""

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith("__"):
            raise AttributeError(name)
        return np.empty(0)

    def __setattr__(self, name: str, value: object) -> None:
        raise UsageError("Cannot assign a value to an empty binding.")


def updated(xp: ArrayModule, array: PyTree, index: Index, value: ArrayLike) -> Array:
    """Return a copy of an array with another value at an index."""
    if xp is not np:
        array = xp.asarray(array)
        return array.at[index].set(xp.asarray(value, array.dtype))
    array = np.array(array)
    array[index] = value
    return array
