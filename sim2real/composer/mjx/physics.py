"""A model and its state on MJX, inside a compiled program; hooks see the interface of the C engine's physics."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer import layout
from sim2real.composer.element import as_elements
from sim2real.composer.mjx import stepping, warp
from sim2real.composer.mjx.random import JaxRandomState
from sim2real.composer.named import Named
from sim2real.errors import UsageError

_MATRICES = ("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat")
"""MJX keeps them as ``(n, 3, 3)``, MuJoCo as ``(n, 9)``."""


class DataView:
    """``physics.data``: fields of the state, in MuJoCo's shapes."""

    def __init__(self, physics: MjxPhysics) -> None:
        object.__setattr__(self, "_physics", physics)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        data = self._physics.mjx_data
        value = getattr(data, name) if name in data.__dataclass_fields__ else getattr(data._impl, name)
        if value is None:  # what all copies have in common on Warp
            raise AttributeError(f"a copy has no {name!r} of its own")
        return jnp.reshape(value, (-1, 9)) if name in _MATRICES else value

    def __setattr__(self, name: str, value: Any) -> None:
        self._physics.replace("data", name, value)


class ModelView:
    """``physics.model``: what differs from copy to copy comes from MJX, the rest from ``ptr``, the ``MjModel``."""

    def __init__(self, physics: MjxPhysics) -> None:
        object.__setattr__(self, "_physics", physics)

    @property
    def ptr(self) -> Any:
        """The compiled ``mujoco.MjModel``."""
        return self._physics.host

    def name2id(self, name: str, kind: str) -> int:
        """Return the number of an element; UsageError when there is none of that name."""
        return layout.resolve(self.ptr, kind, (name,))[0]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        model = self._physics.mjx_model
        value = getattr(model, name) if name in model.__dataclass_fields__ else None
        return value if isinstance(value, jax.Array) else getattr(self.ptr, name)

    def __setattr__(self, name: str, value: Any) -> None:
        self._physics.replace("model", name, value)


class MjxBinding:
    """Bound elements on MJX: attributes are JAX arrays; setting one replaces the physics's state or model."""

    __slots__ = ("_fields", "_ids", "_kind", "_physics", "_single", "element_id")

    def __init__(self, physics: MjxPhysics, kind: str, ids: tuple[int, ...], single: bool) -> None:
        numbers = ids[0] if single else np.array(ids, int)
        values = (layout.attributes(kind), ids, kind, physics, single, numbers)
        for name, value in zip(self.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    def place(self, name: str) -> tuple[layout.Field, Any]:
        """Return the field that holds an attribute and the index of the bound rows in it."""
        field = self._fields.get(name)
        if field is None:
            known = ", ".join(sorted(self._fields))
            raise AttributeError(f"bound element <{self._kind}> does not have attribute {name!r}. Available: {known}")
        return field, layout.index(self._physics.host, field, self._ids, self._single)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        field, index = self.place(name)
        return self._physics.read(field)[index]

    def __setattr__(self, name: str, value: Any) -> None:
        field, index = self.place(name)
        array = jnp.asarray(self._physics.read(field))
        self._physics.replace(field.struct, field.name, array.at[index].set(jnp.asarray(value, array.dtype)))


class MjxPhysics:
    """The physics that hooks see while a program is traced: the same calls as on the C engine.

    Setting something replaces the state that this object holds; arrays that were read before keep their values.

    Args:
        host: The compiled ``mujoco.MjModel``.
        model: The ``mjx.Model``.
        data: The ``mjx.Data``.
        variables: What tasks keep from hook to hook: name -> array.
        legacy: After a step, also compute positions and velocities of the new state.
        engine: What steps: the module ``stepping``, or a ``WarpEngine``.

    Attributes:
        np: The module that computes with this engine's arrays: ``jax.numpy``.
        changed: Names of the model's fields that were set.
        dry: Whether steps compute nothing: for finding out what hooks set and keep.
        failed: Whether no acceptable initial state was found, a boolean array.
    """

    np: Any = jnp

    def __init__(
        self,
        host: Any,
        model: Any,
        data: Any,
        variables: dict[str, Any],
        legacy: bool = True,
        engine: Any = stepping,
    ) -> None:
        self._engine = engine
        self.host, self.mjx_model, self.mjx_data = host, model, data
        self.variables = variables
        self.legacy_step = legacy
        self.changed: set[str] = set()
        self.failed: Any = jnp.zeros((), bool)
        self.is_dirty = self.dry = False
        self._compiled = model
        self.data, self.model = DataView(self), ModelView(self)
        self.named = Named(host, self.model, self.data)

    def read(self, field: layout.Field) -> Any:
        """Return a whole field; computes everything anew first when an earlier write makes it out of date."""
        if field.struct == "model":
            return getattr(self.model, field.name)
        if self.is_dirty and not field.triggers:
            self.forward()
        try:
            return getattr(self.data, field.name)
        except AttributeError:
            raise AttributeError(f"MJX has no field {field.name!r} in its data") from None

    def replace(self, struct: str, name: str, value: Any) -> None:
        """Set a whole field of the model or the state.

        Raises:
            UsageError: When the field is a constant of compiled programs.
        """
        holder = self.mjx_model if struct == "model" else self.mjx_data
        current = getattr(holder, name) if name in holder.__dataclass_fields__ else None
        if not isinstance(current, jax.Array):
            raise UsageError(
                f"MJX cannot change {name!r} inside a compiled program: it is one of its constants",
                hint="set it in the model before it is compiled, or use the C engine",
            )
        if struct == "model" and warp.is_warp(holder):
            warp.check_field(name)
        value = jnp.reshape(jnp.asarray(value, current.dtype), current.shape)
        if struct == "model":
            self.mjx_model = self.mjx_model.replace(**{name: value})
            self.changed.add(name)
            self.is_dirty = True
        else:
            self.mjx_data = self.mjx_data.replace(**{name: value})
            self.is_dirty = self.is_dirty or name in layout.TRIGGERS

    def initial(self, elements: Any, name: str) -> Any:
        """Return an attribute of elements as it was compiled."""
        field, index = self.bind(elements).place(name)
        holder = self._compiled if field.struct == "model" else self.mjx_data
        return getattr(holder, field.name)[index]

    # -- the interface of the C engine's physics

    def time(self) -> Any:
        """Return the simulated time [s]."""
        return self.mjx_data.time

    def timestep(self) -> Any:
        """Return the time that a step takes [s]."""
        return self.mjx_model.opt.timestep

    def control(self) -> Any:
        """Return the controls, shape ``(nu,)``."""
        return self.mjx_data.ctrl

    def set_control(self, control: Any) -> None:
        """Set the controls, shape ``(nu,)`` [the actuators' units]."""
        self.mjx_data = self.mjx_data.replace(ctrl=jnp.asarray(control, self.mjx_data.ctrl.dtype))

    def position(self) -> Any:
        """Return qpos, shape ``(nq,)``."""
        return self.mjx_data.qpos

    def velocity(self) -> Any:
        """Return qvel, shape ``(nv,)``."""
        return self.mjx_data.qvel

    def step(self) -> None:
        """Advance by a time step."""
        if self.dry:
            return
        self.mjx_data = self._engine.advance(self.mjx_model, self.mjx_data, self.legacy_step)

    def forward(self, actuation: bool = True) -> None:
        """Compute everything that follows from the state, without advancing."""
        if not self.dry:
            self.mjx_data = self._engine.forward(self.mjx_model, self.mjx_data, actuation)
        self.is_dirty = False

    def suppress_physics_errors(self) -> Any:
        """MJX raises none."""
        return contextlib.nullcontext()

    def bind(self, elements: Any) -> Any:
        """Return the attributes of an element, or of several of one kind.

        Raises:
            UsageError: When an element is none, is of another kind than the rest, or is not in the compiled model.
        """
        found, single = as_elements(elements)
        if not found:
            from sim2real.composer.binding import EmptyBinding

            return EmptyBinding()
        layout.attributes(found[0].kind)
        ids = layout.resolve(self.host, found[0].kind, tuple(e.full_identifier for e in found))
        return MjxBinding(self, found[0].kind, ids, single)

    def get(self, elements: Any, name: str) -> Any:
        """Return an attribute of elements; the same call on both engines."""
        return getattr(self.bind(elements), name)

    def set(self, elements: Any, name: str, value: Any) -> MjxPhysics:
        """Set an attribute of elements and return the physics; the same call on both engines."""
        setattr(self.bind(elements), name, value)
        return self

    def write(self, elements: Any, name: str, value: Any, index: Any) -> MjxPhysics:
        """Set a part of an attribute of elements; the same call on both engines."""
        whole = jnp.asarray(self.get(elements, name))
        return self.set(elements, name, whole.at[index].set(jnp.asarray(value, whole.dtype)))

    def fail(self, condition: Any = True) -> None:
        """Note that no acceptable initial state was found where the condition holds; another attempt follows."""
        self.failed = self.failed | condition

    # -- state as a tree

    def tree(self, random_state: JaxRandomState) -> Any:
        """Return all that changes, as a tree."""
        leaves = {name: getattr(self.mjx_model, name) for name in sorted(self.changed)}
        return self.mjx_data, leaves, dict(self.variables), random_state.key, dict(random_state.memory)

    def load(self, tree: Any, random_state: JaxRandomState) -> None:
        """Take over what ``tree`` returned."""
        self.mjx_data, leaves, variables, random_state.key, memory = tree
        if leaves:
            self.mjx_model = self.mjx_model.replace(**leaves)
        self.changed |= set(leaves)
        for mine, theirs in ((self.variables, variables), (random_state.memory, memory)):
            mine.clear()
            mine.update(theirs)

    def retry(self, attempt: Callable[[], None], random_state: JaxRandomState, attempts: int) -> Any:
        """Run a function until it no longer calls ``fail``, at most so many times; return whether the last one failed.

        Every attempt starts from the same state, with new random numbers.
        """
        start, model, outer, dirty = self.tree(random_state), self.mjx_model, self.failed, self.is_dirty

        def once(carry: Any) -> Any:
            _, tree, count = carry
            self.mjx_model, self.is_dirty = model, dirty
            self.load((*start[:3], tree[3], start[4]), random_state)
            self.failed = jnp.zeros((), bool)
            attempt()
            return self.failed, self.tree(random_state), count + 1

        carry = once((None, start, jnp.zeros((), int)))
        if attempts > 1:
            carry = jax.lax.while_loop(lambda c: c[0] & (c[2] < attempts), once, carry)
        self.mjx_model, self.failed, self.is_dirty = model, outer, True
        self.load(carry[1], random_state)
        return carry[0]
