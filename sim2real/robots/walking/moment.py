"""What the terms of a walking robot's reward see, and the usual terms."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Moment(NamedTuple):
    """A policy step of a walking robot, from the true state after it. Vectors of the base are in its axes.

    Attributes:
        command: Shape ``(3,)``: forwards, to the left [m/s], yaw rate [rad/s].
        linear: Shape ``(3,)``: velocity of the base [m/s].
        angular: Shape ``(3,)``: angular velocity of the base [rad/s].
        gravity: Shape ``(3,)``: direction of gravity.
        mean: Shape ``(3,)``: forward, left and yaw velocity, smoothed over 0.4 s.
        height: Height of the base above its lowest foot [m].
        offset: Shape ``(joints,)``: position less stance [rad].
        torque: Shape ``(joints,)`` [N m].
        last: Shape ``(joints,)``: this step's action.
        before: Shape ``(joints,)``: the action before it.
        touches: Shape ``(feet,)``, bool.
        lands: Shape ``(feet,)``, bool: the foot landed in this step.
        swing_s: Shape ``(feet,)``: time in the air of the last swing [s].
        slip_m_s: Shape ``(feet,)``: speed of the foot along the ground while it touches [m/s].
        falls: Whether the episode ends with this step, bool.
    """

    command: jax.Array
    linear: jax.Array
    angular: jax.Array
    gravity: jax.Array
    mean: jax.Array
    height: jax.Array
    offset: jax.Array
    torque: jax.Array
    last: jax.Array
    before: jax.Array
    touches: jax.Array
    lands: jax.Array
    swing_s: jax.Array
    slip_m_s: jax.Array
    falls: jax.Array

    @property
    def moving(self) -> jax.Array:
        """1 if a velocity is commanded, 0 if the robot has to stand still."""
        return (jnp.sum(self.command**2) > 0.01).astype(jnp.float32)

    # -- measures that terms weigh

    def tracks(self, width: float = 0.25) -> jax.Array:
        """Return 1 at the commanded velocity, less beside it; ``width``: squared error of 1/e [m^2/s^2]."""
        return jnp.exp(-jnp.sum((self.command[:2] - self.linear[:2]) ** 2) / width)

    def turns(self, width: float = 0.25) -> jax.Array:
        """Return 1 at the commanded yaw rate, less beside it."""
        return jnp.exp(-((self.command[2] - self.angular[2]) ** 2) / width)

    def action_rate(self) -> jax.Array:
        """Return the squared change from the last action."""
        return jnp.sum((self.last - self.before) ** 2)

    def steps(self, least_s: float = 0.1, most_s: float = 0.5) -> jax.Array:
        """Return how long the feet that landed were in the air, beyond ``least_s``; 0 while standing still [s]."""
        credit = jnp.clip(self.swing_s, 0.0, most_s) - least_s
        return self.moving * jnp.sum(jnp.where(self.lands, credit, 0.0))

    def slip(self) -> jax.Array:
        """Return the squared speed of feet along the ground."""
        return jnp.sum(jnp.clip(self.slip_m_s, 0.0, 2.0) ** 2)

    def lifted_at_rest(self) -> jax.Array:
        """Return the number of feet in the air while the robot has to stand still."""
        return (1.0 - self.moving) * jnp.sum(~self.touches)
