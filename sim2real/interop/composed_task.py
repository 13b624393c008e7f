"""A composed task as a pure environment."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from dm_env import specs

from sim2real.composer.physics.mjx.environment import MjxEnvironment, State
from sim2real.errors import UsageError
from sim2real.interop.pure_environment import Transition

if TYPE_CHECKING:
    import jax

    from sim2real.types import Key


class PureTask:
    """A task on MJX; see ``PureEnvironment``.

    Args:
        flat: Whether the observation is one vector, the observables in their order, instead of a dictionary.

    Raises:
        UsageError: When no observable is enabled, or an action is not one array.
    """

    def __init__(self, environment: MjxEnvironment, flat: bool) -> None:
        self.environment, self._flat = environment, flat
        self.period_s, self.length = environment.task.control_timestep, environment.step_limit
        shapes = environment.observation_spec()
        task = environment.task
        # Refuse a task without observations or with a nested action.
        if not shapes:
            available = ", ".join(map(repr, task.observables)) or "none"
            raise UsageError(
                f"task {type(task).__name__} shows its policy nothing: no observable is enabled. "
                f"There are: {available}",
                hint="set `enabled = True` for the observables of the policy; a robot with its delays comes from "
                "sim2real.interop",
            )
        action = environment.action_spec()
        if not isinstance(action, specs.Array):
            raise UsageError(
                f"an action must be one array, and the task's action_spec is {action!r}",
                hint="override action_spec in the task",
            )
        # Observations are one vector, or an array for each name.
        self.action_spec = action
        self.observation_spec: specs.Array | dict[str, specs.Array]
        if flat:
            self.observation_spec = specs.Array((sum(s.size for s in shapes.values()),), np.float32)
        else:
            self.observation_spec = {name: specs.Array(s.shape, s.dtype) for name, s in shapes.items()}

    def reset(self, key: Key) -> Transition[State]:
        """Return a copy at the start of an episode."""
        return self._transition(self.environment.reset(key))

    def step(self, state: State, action: jax.Array) -> Transition[State]:
        """Return the copy one control step later."""
        return self._transition(self.environment.step(state, action))

    def is_truncated(self, state: State) -> jax.Array:
        """Return whether the time limit has ended the episode."""
        return state.truncated

    def reseed(self, state: State, key: Key) -> State:
        """Return the start of an episode with random numbers from ``key``; any other state as it is."""
        return self.environment.select(state.steps == 0, dataclasses.replace(state, key=key), state)

    def _transition(self, state: State) -> Transition[State]:
        observation = state.observation
        if self._flat:
            observation = jnp.concatenate([jnp.ravel(v) for v in observation.values()])
        info = {"discount": state.discount, "failed": state.failed}
        terminated = state.done & ~state.truncated
        return Transition(state, observation, state.reward, terminated, state.truncated, info, {})
