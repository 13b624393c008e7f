"""Parts of a servo model: position loop, duty limit, motor torque with back-EMF and saturation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp

if TYPE_CHECKING:
    from sim2real.graph.base import Value


def saturated(error: Value, limit: Value) -> Value:
    """Return a position error clipped to ``[-limit, limit]``: beyond it the position loop is at full duty."""
    return jnp.clip(error, -limit, limit)


def position_duty(goal: Value, position: Value, gain: Value, counts_per_unit: float, full: float) -> Value:
    """Return the duty, in [-1, 1], of a position loop that works on integers, like that of DYNAMIXEL's firmware.

    Args:
        goal: Goal position [rad].
        position: Present position [rad].
        gain: PWM steps per count of error.
        counts_per_unit: Encoder counts per radian.
    """
    off = jnp.floor(goal * counts_per_unit + 0.5) - jnp.floor(position * counts_per_unit + 0.5)
    return jnp.trunc(jnp.clip(gain * off, -full, full)) / full


def motor_torque(duty: Value, velocity: Value, stall: Value, back_emf: Value, softness: Value = 0.0) -> Value:
    """Return the torque of a motor under a duty [N m].

    Args:
        duty: In [-1, 1].
        velocity: [rad/s].
        stall: Torque at full duty and standstill, without saturation [N m].
        back_emf: Torque lost to back-EMF per speed [N m s/rad].
        softness: Saturation: the torque stays below ``1 / softness`` [1/(N m)].
    """
    linear = stall * duty - back_emf * velocity
    return linear / (1.0 + softness * jnp.abs(linear))
