"""A model and its state on MJX, inside a compiled program, with the interface of the C engine's physics."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics import layout
from sim2real.composer.physics.base import BaseBinding, BaseModelView, BasePhysics
from sim2real.composer.physics.mjx import constants, stepping
from sim2real.composer.physics.mjx.random import JaxRandomState
from sim2real.composer.physics.named import Named
from sim2real.errors import UsageError
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Elements
    from sim2real.composer.types import ArrayLike, MjModel

_FLUID = ("opt.density", "opt.viscosity", "opt.wind")
_SWITCHES = {**dict.fromkeys(_FLUID, "opt._impl.has_fluid_params"), "body_gravcomp": "flg_gravcomp"}
"""Field whose effect MJX leaves out if it is 0 in the compiled model -> the flag that switches the effect on once it is
set.
"""
_WARP_SWITCHES: dict[str, str] = dict.fromkeys(_FLUID, "_impl.has_fluid")
"""The same on Warp."""


Carried = tuple[mjx.Data, dict[str, jax.Array], dict[str, PyTree], jax.Array, dict[str, jax.Array]]
"""All changing values: the state, fields of the model, variables of tasks, a key, values of variations."""


_MATRICES = ("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat")
"""Fields that MJX stores as ``(n, 3, 3)``, MuJoCo as ``(n, 9)``."""


class MjxPhysics(BasePhysics):
    """The physics that hooks see while a program is traced: the same calls as on the C engine.

    Setting something replaces the state that this object holds; arrays that were read before keep their values.

    Args:
        variables: Values that tasks keep between hooks: name -> array.
        legacy: Whether to compute positions and velocities of the new state after a step.

    Attributes:
        changed: Names of the model's fields that were set.
        dry: Whether steps compute nothing, to find the values that hooks set.
        failed: Whether no acceptable initial state was found, a boolean array.
    """

    np = jnp

    def __init__(
        self,
        host: MjModel,
        model: mjx.Model,
        data: mjx.Data | None,
        variables: dict[str, PyTree],
        legacy: bool = True,
        engine: stepping.Engine | None = None,
    ) -> None:
        self._engine = engine or stepping.JaxEngine()
        self.host, self.mjx_model = host, model
        self.mjx_data: PyTree = data
        self.variables, self.start = variables, data
        self.legacy_step = legacy
        self.changed: set[str] = set()
        self.failed = jnp.zeros((), bool)
        self.is_dirty: bool | jax.Array = False
        self.dry = False
        self._where: jax.Array | None = None
        self._compiled = model
        self.data, self.model = MjxDataView(self), MjxModelView(self)
        self.named = Named(host, self.model, self.data)

    def read(self, field: layout.Field) -> PyTree:
        """Return a whole field; if an earlier write made it out of date, all quantities are computed first."""
        if not field.triggers:
            self._settle()
        if field.struct == "model":
            return getattr(self.model, field.name)
        try:
            return getattr(self.data, field.name)
        except AttributeError:
            raise AttributeError(f"MJX has no field {field.name!r} in its data") from None

    def mark_as_dirty(self) -> None:
        self.is_dirty = True

    def _settle(self) -> None:
        """Compute all derived quantities if something was written since they were last computed.

        Usually this is known during the trace. If it depends on the step before, a flag in the state lets the program
        decide.
        """
        dirty, where = self.is_dirty, self._where
        if dirty is False:
            return
        if dirty is True and where is None:
            self.forward()
            return
        here = dirty if where is None else where & dirty
        if not self.dry:
            model, engine = self.mjx_model, self._engine
            self.mjx_data = jax.lax.cond(here, lambda d: engine.forward(model, d), lambda d: d, self.mjx_data)
        self.is_dirty = False if where is None else ~where & dirty

    @contextlib.contextmanager
    def only_where(self, condition: jax.Array) -> Iterator[None]:
        """Let reads in a ``with`` block compute quantities only where a condition, a boolean array, is true."""
        self._where = condition
        try:
            yield
        finally:
            self._where = None

    def check(self, struct: str, name: str, rows: int | slice | np.ndarray = slice(None)) -> None:
        """Refuse to set rows of a field if MJX would ignore it.

        Args:
            rows: Rows of the field; default: all.

        Raises:
            UsageError: MJX would ignore the field.
        """
        if struct != "model" or stepping.is_warp(self.mjx_model):
            return
        if name.endswith("_frictionloss") and not np.all(np.asarray(getattr(self.host, name))[rows] > 0):
            raise UsageError(
                f"MJX ignores {name!r} in rows that are 0 in the compiled model, and these rows are set",
                hint="compile the model with a small friction, such as 1e-6",
            )
        if name == "geom_size" and np.any(self.host.geom_type == mj.mjtGeom.mjGEOM_HFIELD):
            raise UsageError(
                "MJX looks for contacts with height fields within the compiled sizes of geoms: 'geom_size' cannot vary",
                hint="set it in initialize_episode_mjcf, or use the C engine",
            )

    def replace(self, struct: str, name: str, value: ArrayLike) -> None:
        """Set a whole field of the model or the state, such as ``qpos``, ``geom_size`` or ``opt.gravity``.

        Raises:
            UsageError: The field is a constant of compiled programs.
        """
        holder = self.mjx_model if struct == "model" else self.mjx_data
        current = _get(holder, name)
        if not isinstance(current, jax.Array):
            raise constant(name)
        if struct == "model" and stepping.is_warp(self.mjx_model):
            stepping.check_field(name)
        try:
            value = jnp.broadcast_to(jnp.asarray(value, current.dtype), current.shape)
        except ValueError:
            value = jnp.reshape(jnp.asarray(value, current.dtype), current.shape)
        if struct == "data":
            self.mjx_data = self.mjx_data.replace(**{name: value})
            return
        self.mjx_model = stepping.with_fields(self.mjx_model, {name: value})
        self.changed.add(name)
        self.switch_on()

    def switch_on(self) -> None:
        """Let programs compute the effects of fields that hooks set although they are 0 in the compiled model."""
        on_warp = stepping.is_warp(self.mjx_model)
        switches: dict[str, str] = _WARP_SWITCHES if on_warp else _SWITCHES
        for path in {switches[name] for name in self.changed if name in switches}:
            if not _get(self.mjx_model, path):
                self.mjx_model = stepping.with_fields(self.mjx_model, {path: True})
        implicit = self.mjx_model.opt.integrator == mjx.IntegratorType.IMPLICITFAST
        if self.changed.intersection(_FLUID) and implicit and not on_warp:
            raise UsageError("MJX has no fluid forces with the integrator implicitfast", hint="use Euler or RK4")

    def recompute_constants(self) -> None:
        for name, value in constants.derive(self.host, self.mjx_model).items():
            self.replace("model", name, value)
        self.mark_as_dirty()

    def field(self, name: str) -> jax.Array:
        """Return a field of this copy's model, such as ``dof_damping`` or ``opt.gravity``."""
        return _get(self.mjx_model, name)

    def initial(self, elements: Elements, name: str) -> PyTree:
        """Return an attribute of elements as it was compiled."""
        field, index = self.bind(elements).locate(name)
        holder = self._compiled if field.struct == "model" else self.mjx_data
        return getattr(holder, field.name)[index]

    # -- the interface of the C engine's physics

    def set_control(self, control: ArrayLike) -> None:
        """Set the controls, shape ``(nu,)`` [the actuators' units]; raise UsageError for another shape."""
        old = self.mjx_data.ctrl
        control = jnp.asarray(control, old.dtype)
        if control.size not in (1, old.size):
            raise UsageError(
                f"there are {old.size} controls, and set_control was given an array of shape {control.shape}",
                hint="if actions are no controls, override action_spec and before_step in the task",
            )
        self.mjx_data = self.mjx_data.replace(ctrl=jnp.broadcast_to(jnp.ravel(control), old.shape))

    def _copied(self, array: jax.Array) -> jax.Array:
        return array

    def reset(self, keyframe_id: int | None = None) -> None:
        """Return to the initial state, or to a keyframe, and remove all variables.

        Raises:
            UsageError: There is no such keyframe.
        """
        self.mjx_data = self.start
        if keyframe_id is not None:
            self.check_keyframe(keyframe_id)
            names = {"qpos": "qpos", "qvel": "qvel", "act": "act", "ctrl": "ctrl", "time": "time"}
            for name, key in {**names, "mocap_pos": "mpos", "mocap_quat": "mquat"}.items():
                self.replace("data", name, getattr(self.host, f"key_{key}")[keyframe_id])
        self.variables.clear()
        self.forward(actuation=False)

    def step(self) -> None:
        if self.dry:
            return
        self.mjx_data = self._engine.advance(self.mjx_model, self.mjx_data, self.legacy_step)

    def forward(self, actuation: bool = True) -> None:
        if not self.dry:
            self.mjx_data = self._engine.forward(self.mjx_model, self.mjx_data, actuation)
        self.is_dirty = False

    def suppress_physics_errors(self) -> contextlib.nullcontext[None]:
        """Do nothing: MJX raises no errors of physics."""
        return contextlib.nullcontext()

    def _new_binding(self, kind: str, ids: tuple[int, ...], single: bool) -> MjxBinding:
        return MjxBinding(self, kind, ids, single)

    def fail(self, condition: ArrayLike = True) -> None:
        """Reject the initial state where the condition is true; another attempt follows."""
        self.failed = self.failed | jnp.asarray(condition)

    # -- state as a tree

    def tree(self, random_state: JaxRandomState) -> Carried:
        """Return all changing values, as a tree."""
        leaves = {name: _get(self.mjx_model, name) for name in sorted(self.changed)}
        variables = {name: jax.tree_util.tree_map(jnp.asarray, value) for name, value in self.variables.items()}
        return self.mjx_data, leaves, variables, random_state.key, dict(random_state.memory)

    def load(self, tree: Carried, random_state: JaxRandomState) -> None:
        """Set all changing values from a result of ``tree``."""
        self.mjx_data, leaves, variables, random_state.key, memory = tree
        if leaves:
            self.mjx_model = stepping.with_fields(self.mjx_model, leaves)
        self.changed |= set(leaves)
        for mine, theirs in ((self.variables, variables), (random_state.memory, memory)):
            mine.clear()
            mine.update(theirs)

    def retry(self, attempt: Callable[[], None], random_state: JaxRandomState, attempts: int) -> jax.Array:
        """Run a function until it does not call ``fail``, at most ``attempts`` times; return whether it failed.

        Every attempt starts from the same state, with new random numbers.
        """
        start, model, outer, dirty = self.tree(random_state), self.mjx_model, self.failed, self.is_dirty

        def once(carry: PyTree) -> PyTree:
            _, tree, count = carry
            self.mjx_model, self.is_dirty = model, dirty
            self.load((*start[:3], tree[3], start[4]), random_state)
            self.failed = jnp.zeros((), bool)
            attempt()
            return self.failed, self.tree(random_state), count + 1

        carry = once((None, start, jnp.zeros((), int)))
        if attempts > 1 and not self.dry:
            carry = jax.lax.while_loop(lambda c: c[0] & (c[2] < attempts), once, carry)
        self.mjx_model, self.failed, self.is_dirty = model, outer, True
        self.load(carry[1], random_state)
        return carry[0]


def _get(holder: PyTree, path: str) -> PyTree:
    """Return a field of a model or a state by its path, or None."""
    for step in path.split("."):
        holder = getattr(holder, step, None)
    return holder


SET_BEFORE = "set it in initialize_episode_mjcf or after_compile, which run before that, or use the C engine"


def constant(name: str) -> UsageError:
    """Return the error for setting a constant field."""
    return UsageError(
        f"MJX cannot change {name!r} inside a compiled program: it is one of its constants", hint=SET_BEFORE
    )


class Struct:
    """A part of the compiled ``MjModel``, such as ``stat``: it can only be read."""

    def __init__(self, native: object, name: str) -> None:
        object.__setattr__(self, "_native", native)
        object.__setattr__(self, "_name", name)

    def __getattr__(self, name: str) -> PyTree:
        return shown(getattr(self._native, name), f"{self._name}.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        raise constant(f"{self._name}.{name}")


def shown(value: PyTree, name: str) -> PyTree:
    """Return a value of the compiled model for hooks, which cannot change it."""
    if isinstance(value, np.ndarray):
        return read_only(value.view())
    return Struct(value, name) if type(value).__module__.startswith("mujoco") and not callable(value) else value


def read_only(array: PyTree) -> PyTree:
    """Make a numpy array read-only, because all copies share it."""
    if isinstance(array, np.ndarray):
        array.flags.writeable = False
    return array


class OptionView:
    """``physics.model.opt``: gravity, wind and so on can be set for each copy; other options are constant."""

    def __init__(self, physics: MjxPhysics) -> None:
        object.__setattr__(self, "_physics", physics)

    def __getattr__(self, name: str) -> PyTree:
        value = getattr(self._physics.mjx_model.opt, name, None)
        return value if isinstance(value, jax.Array) else shown(getattr(self._physics.host.opt, name), f"opt.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("model", f"opt.{name}", value)


class MjxModelView(BaseModelView):
    """``physics.model``: fields that differ from copy to copy come from MJX, all others from the ``MjModel``."""

    def __init__(self, physics: MjxPhysics) -> None:
        super().__init__(physics.host)
        object.__setattr__(self, "_physics", physics)
        object.__setattr__(self, "opt", OptionView(physics))

    def __getattr__(self, name: str) -> PyTree:
        if name.startswith("__"):
            raise AttributeError(name)
        model = self._physics.mjx_model
        value = getattr(model, name) if name in model.__dataclass_fields__ else None
        return value if isinstance(value, jax.Array) else shown(getattr(self.ptr, name), name)

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("model", name, value)


class MjxDataView:
    """``physics.data``: fields of the state, in MuJoCo's shapes."""

    def __init__(self, physics: MjxPhysics) -> None:
        object.__setattr__(self, "_physics", physics)

    def __getattr__(self, name: str) -> PyTree:
        if name.startswith("__"):
            raise AttributeError(name)
        data = self._physics.mjx_data
        value = getattr(data, name) if name in data.__dataclass_fields__ else getattr(data._impl, name)
        if value is None:  # arrays that all copies share on Warp
            raise AttributeError(f"a copy has no {name!r} of its own")
        return jnp.reshape(value, (-1, 9)) if name in _MATRICES else value

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("data", name, value)


class MjxBinding(BaseBinding):
    """Bound elements on MJX: attributes are JAX arrays; setting one replaces the physics's state or model."""

    __slots__ = ()
    _physics: MjxPhysics

    def read(self, name: str) -> PyTree:
        field, index = self.locate(name)
        return read_only(self._physics.read(field)[index])

    def write(self, name: str, value: ArrayLike) -> None:
        field, index = self.locate(name)
        array = jnp.asarray(self._physics.read(field))
        self._physics.check(field.struct, field.name, index)
        self._physics.replace(field.struct, field.name, array.at[index].set(jnp.asarray(value, array.dtype)))
        if field.triggers:
            self._physics.mark_as_dirty()


def freeze(model: MjModel) -> None:
    """Make the arrays of a compiled ``MjModel`` read-only, because programs no longer read them."""
    for name in layout.array_fields("model"):
        read_only(getattr(model, name))
