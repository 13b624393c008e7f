"""A composed task as an environment for PPO, without a graph: one control step is one row."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.mjx.environment import MjxEnvironment
from sim2real.composer.task import UNLIMITED
from sim2real.errors import UsageError
from sim2real.train.protocol import Step

if TYPE_CHECKING:
    from sim2real.composer.mjx.environment import State


class TaskEnvironment:
    """A composed task on MJX as an environment; the observation is the vector of all its observables, in their order.

    Args:
        environment: The task; it needs a time limit unless its episodes end by themselves.

    Raises:
        UsageError: When the action is not a vector with bounds.
    """

    def __init__(self, environment: MjxEnvironment) -> None:
        self.environment = environment
        self.observation_size = sum(leaf.size for leaf in environment.observation_spec().values())
        spec = environment.action_spec()
        bounds = [np.broadcast_to(getattr(spec, name, np.inf), spec.shape) for name in ("minimum", "maximum")]
        if len(spec.shape) != 1 or not (np.abs(bounds) < UNLIMITED).all():
            raise UsageError(
                f"PPO's actions are vectors with bounds, and the task's action_spec is {spec!r}",
                hint="give every actuator a ctrlrange, or override action_spec in the task",
            )
        self.action_low, self.action_high = bounds

    def reset(self, key: jax.Array) -> tuple[State, jax.Array]:
        """Return the state at the start of an episode and the first observation."""
        state = self.environment.reset(key)
        return state, _vector(state)

    def step(self, state: State, action: jax.Array, key: jax.Array) -> Step:
        """Make one control step.

        Args:
            state: What ``reset`` or ``step`` returned.
            action: Shape ``(A,)`` [the actuators' units].
            key: Not used: the state has a key of its own.
        """
        del key
        new = self.environment.step(state, action)
        ends = new.done & ~new.truncated
        return Step(new, _vector(new), new.reward, ends, new.truncated, jnp.bool_(True), {})


def _vector(state: State) -> jax.Array:
    """Return all observables as one vector, shape ``(O,)``."""
    values = [jnp.ravel(value) for value in state.observation.values()]
    return jnp.concatenate(values) if values else jnp.zeros(0)
