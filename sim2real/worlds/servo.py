"""What a servo makes of a command: position loop, duty limit, back-EMF, a torque that saturates, gears with play."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp


def saturated(error: Any, limit: Any) -> Any:
    """Return an error that counts no more than ``limit`` either way: a position loop at full duty."""
    return jnp.clip(error, -limit, limit)


def position_duty(goal: Any, position: Any, gain: Any, counts_per_unit: float, full: float) -> Any:
    """Return the duty, in [-1, 1], of a firmware that works on whole counts, as DYNAMIXEL's position loop does.

    Args:
        goal: [rad].
        position: [rad].
        gain: PWM steps per count of error.
        counts_per_unit: Encoder counts per radian.
        full: PWM steps at full duty.
    """
    off = jnp.floor(goal * counts_per_unit + 0.5) - jnp.floor(position * counts_per_unit + 0.5)
    return jnp.trunc(jnp.clip(gain * off, -full, full)) / full


def motor_torque(duty: Any, velocity: Any, stall: Any, back_emf: Any, softness: Any = 0.0) -> Any:
    """Return the torque of a motor under a duty [N m].

    Args:
        duty: In [-1, 1].
        velocity: [rad/s].
        stall: Torque at full duty and standstill, before it saturates [N m].
        back_emf: What a speed takes off [N m s/rad].
        softness: How early the torque saturates: it never exceeds ``1 / softness`` [1/(N m)].
    """
    linear = stall * duty - back_emf * velocity
    return linear / (1.0 + softness * jnp.abs(linear))


def play(driver: Any, follower: Any, gap: Any) -> Any:
    """Return where a driven part is: it stays until the driver takes it along, ``gap`` [rad] of play in all."""
    return jnp.clip(follower, driver - 0.5 * gap, driver + 0.5 * gap)
