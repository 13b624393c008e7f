"""A composed task as an environment for PPO, without a graph: one control step is one row."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.mjx.environment import MjxEnvironment
from sim2real.composer.task import UNLIMITED
from sim2real.errors import UsageError
from sim2real.train.protocol import Step


class TaskEnvironment:
    """One copy of a task on MJX; the observation is a vector of all its observables, in their order.

    Args:
        environment: The task as a pure environment, with a time limit unless its episodes end by themselves.

    Raises:
        UsageError: When actions are no vector with bounds.
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

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """Return a copy at the start of an episode and what it observes."""
        state = self.environment.reset(key)
        return state, _vector(state)

    def step(self, state: Any, action: jax.Array, key: jax.Array) -> Step:
        """Take a control step; randomness is the copy's own."""
        del key
        new = self.environment.step(state, action)
        ends = new.done & ~new.truncated
        return Step(new, _vector(new), new.reward, ends, new.truncated, jnp.bool_(True), {})


def _vector(state: Any) -> jax.Array:
    values = [jnp.ravel(value) for value in state.observation.values()]
    return jnp.concatenate(values) if values else jnp.zeros(0)
