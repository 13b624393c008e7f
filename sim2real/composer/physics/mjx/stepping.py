"""A step of MJX that computes the same quantities as a step of dm_control, and the first state of an episode.

Each stage is jitted separately, so that MJX is traced once for all programs with a model of one form, for every use,
batch and derivative. That shortens compilation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, TypeVar, cast

import jax
import jax.numpy as jnp
from mujoco import mjx

from sim2real.composer.physics.mjx.import_mjx import held_links
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.types import PyTree

T = TypeVar("T", mjx.Model, mjx.Data)

_LEAST_FRICTION: Final = 1e-12
"""Dry friction that moves nothing [N m], and does not underflow in single precision."""


def with_fields(tree: T, values: dict[str, PyTree]) -> T:
    """Return a model or a state with other values of some fields, by their paths, such as ``opt.gravity``."""
    return cast("T", tree.tree_replace(values))


def varies(path: str) -> bool:
    """Return whether a field of the model, such as ``body_mass`` or ``opt.gravity``, may differ from copy to copy."""
    from mujoco.mjx.warp import types

    return bool(types._BATCH_DIM["Model"].get(path.replace(".", "__")))


def check_field(path: str) -> None:
    """Refuse a field of the model that cannot differ from copy to copy."""
    if not varies(path):
        raise UsageError(
            f"MJX-Warp cannot change {path!r}: it is the same in all copies",
            hint='set it in the model before it is compiled, or use impl="jax"',
        )


def is_warp(model: mjx.Model) -> bool:
    """Return whether an ``mjx.Model`` is for MuJoCo Warp."""
    return model.impl == mjx.Impl.WARP


class Engine(Protocol):
    """An engine that steps a model: MJX in JAX, or MuJoCo Warp."""

    def advance(self, model: mjx.Model, data: mjx.Data, legacy: bool) -> mjx.Data:
        """Return the data a time step later.

        Args:
            legacy: Whether positions and velocities of the new state are computed, too, as in dm_control. Then the data
                must come from ``forward`` or from an earlier step.
        """
        ...

    def forward(self, model: mjx.Model, data: mjx.Data, actuation: bool = True) -> mjx.Data:
        """Compute all derived quantities; at the start of an episode, without actuation."""
        ...


class JaxEngine(Engine):
    """MJX in JAX."""

    def advance(self, model: mjx.Model, data: mjx.Data, legacy: bool) -> mjx.Data:
        if not legacy:
            return _integrate(model, _forward(model, data))
        # The same stages as without legacy, in another order (``mj_step2; mj_step1``), in the same time.
        rk4 = model.opt.integrator == mjx.IntegratorType.RK4
        return _positions(model, _integrate(model, _forward(model, data) if rk4 else _react(model, data)))

    def forward(self, model: mjx.Model, data: mjx.Data, actuation: bool = True) -> mjx.Data:
        if not actuation:
            flags = model.opt.disableflags | mjx.DisableBit.ACTUATION
            model = with_fields(model, {"opt.disableflags": flags})
        return _forward(model, data)


def _forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute ``mjx.forward``, and accelerometers, which it leaves at 0 in models without constraints."""
    return _react(model, _positions(model, data))


@jax.jit
@held_links()
def _integrate(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    if model.opt.integrator == mjx.IntegratorType.RK4:
        # MuJoCo keeps sensors from before the step, mjx.rungekutta4 those of its last stage
        return mjx.rungekutta4(model, data).replace(sensordata=data.sensordata)
    return mjx.euler(model, data) if model.opt.integrator == mjx.IntegratorType.EULER else mjx.implicit(model, data)


@jax.jit
@held_links()
def _positions(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the quantities of positions and velocities, and set the state as MuJoCo does.

    MJX normalises quaternions in the state, and computes velocities of disabled actuators; MuJoCo has zeros. A joint
    that was compiled with dry friction, and has none or one that underflows, MJX brakes without a limit.
    """
    model = with_fields(model, {"dof_frictionloss": jnp.maximum(model.dof_frictionloss, _LEAST_FRICTION)})
    qpos = data.qpos
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.fwd_velocity(model, data)
    if model.opt.disableflags & mjx.DisableBit.ACTUATION:
        impl: PyTree = data._impl
        data = with_fields(data, {"_impl.actuator_velocity": jnp.zeros_like(impl.actuator_velocity)})
    return mjx.sensor_vel(model, data).replace(qpos=qpos)


@jax.jit
@held_links()
def _react(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute forces and accelerations, given the quantities of positions and velocities."""
    data = mjx.fwd_actuation(model, data)
    if model.opt.disableflags & mjx.DisableBit.ACTUATION:  # MJX would keep values of an earlier step
        data = data.replace(actuator_force=jnp.zeros_like(data.actuator_force))
    data = mjx.fwd_acceleration(model, data)
    impl: PyTree = data._impl
    data = data.replace(qacc=data.qacc_smooth) if impl.efc_J.size == 0 else mjx.solve(model, data)
    return mjx.sensor_acc(model, data)
