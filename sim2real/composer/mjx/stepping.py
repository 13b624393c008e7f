"""One step of MJX that ends where one of dm_control's ends, and the state that an episode starts from."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from mujoco import mjx


def advance(model: Any, data: Any, legacy: bool) -> Any:
    """Return the data a time step later.

    With ``legacy`` the data must be consistent, what ``forward`` or an earlier step returned, and that is no dearer:
    the same stages, begun elsewhere (``mj_step2; mj_step1``).

    Args:
        model: The ``mjx.Model``.
        data: The ``mjx.Data``.
        legacy: Whether positions and velocities of the new state are computed too, as in dm_control.
    """
    if not legacy:
        return _integrate(model, forward(model, data))
    if model.opt.integrator == mjx.IntegratorType.RK4:
        return _positions(model, _integrate(model, forward(model, data)))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    return _positions(model, _integrate(model, _accelerate(model, data)))


def _integrate(model: Any, data: Any) -> Any:
    if model.opt.integrator == mjx.IntegratorType.RK4:
        # MuJoCo leaves sensors as they were before the step, mjx.rungekutta4 as in its last stage
        return mjx.rungekutta4(model, data).replace(sensordata=data.sensordata)
    return mjx.euler(model, data) if model.opt.integrator == mjx.IntegratorType.EULER else mjx.implicit(model, data)


def forward(model: Any, data: Any, actuation: bool = True) -> Any:
    """Compute everything that follows from the state; without actuation, as at the start of an episode.

    ``mjx.forward`` leaves accelerometers and force sensors at 0 in models without constraints; this does not.

    Args:
        model: The ``mjx.Model``.
        data: The ``mjx.Data``.
        actuation: Whether actuators act.
    """
    if not actuation:
        flags = model.opt.disableflags | mjx.DisableBit.ACTUATION
        model = model.tree_replace({"opt.disableflags": flags})
    data = _positions(model, data)
    return _accelerate(model, mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data)))


def _positions(model: Any, data: Any) -> Any:
    """Compute what follows from positions and velocities, and leave the state as MuJoCo does.

    MJX writes quaternions back normalized, and has velocities of actuators that are switched off; MuJoCo has zeros.
    """
    qpos = data.qpos
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.fwd_velocity(model, data)
    if model.opt.disableflags & mjx.DisableBit.ACTUATION:
        data = data.tree_replace({"_impl.actuator_velocity": jnp.zeros_like(data._impl.actuator_velocity)})
    return mjx.sensor_vel(model, data).replace(qpos=qpos)


def _accelerate(model: Any, data: Any) -> Any:
    data = data.replace(qacc=data.qacc_smooth) if data._impl.efc_J.size == 0 else mjx.solve(model, data)
    return mjx.sensor_acc(model, data)
