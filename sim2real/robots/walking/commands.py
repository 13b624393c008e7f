"""The velocities that a walking robot is commanded in an episode."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.types import Array, Key, Scalar


@dataclass(frozen=True)
class Commands:
    """Commands that are drawn for an episode, one after the other; after the last one the first follows.

    Attributes:
        most: Largest magnitudes: forwards, to the left [m/s], yaw rate [rad/s].
        every_s: How long a command lasts [s].
        stand: Share of the commands that are 0: the robot stands still.
        count: Number of commands that are drawn.
        fixed: The command of all trials; None: each trial has its own.
    """

    most: tuple[float, float, float] = (1.0, 0.6, 0.8)
    every_s: float = 2.5
    stand: float = 0.1
    count: int = 4
    fixed: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.most) < 0 or self.every_s <= 0 or not 0 <= self.stand <= 1 or self.count < 1:
            raise UsageError(f"commands need sizes of at least 0, a time above 0 and a share in [0, 1], got {self}")
        if self.fixed is not None and not np.all(np.abs(self.fixed) <= self.most):
            most = ", ".join(f"{value:g}" for value in self.most)
            raise UsageError(f"the policy follows velocities of at most {most}, got {self.fixed}")

    @property
    def size(self) -> int:
        """Number of entries of an episode's aim."""
        return 3 * self.count

    def draw(self, key: Key) -> Array:
        """Return the commands of an episode, shape ``(3 * count,)``."""
        k_size, k_stand = jax.random.split(key)
        drawn = jax.random.uniform(k_size, (self.count, 3), minval=-1.0, maxval=1.0) * jnp.array(self.most)
        return (drawn * (jax.random.uniform(k_stand, (self.count, 1)) >= self.stand)).ravel()

    def of_trial(self, trial: int) -> np.ndarray:
        """Return the commands of a trial, none of them to stand still.

        The same number gives the same commands, on hardware and in simulation.
        """
        if self.fixed is not None:
            return np.tile(np.array(self.fixed, np.float32), self.count)
        return np.asarray(replace(self, stand=0.0).draw(jax.random.key(trial)), np.float32)

    def at(self, drawn: Array, t_s: Scalar) -> Array:
        """Return the command ``(3,)`` at a time of an episode [s]."""
        xp = namespace(drawn, t_s)
        row = xp.asarray(t_s / self.every_s + 1e-4, dtype=np.int32) % self.count
        return xp.asarray(drawn).reshape(-1, 3)[row]
