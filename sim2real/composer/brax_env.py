"""A composed task as a brax environment."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from brax.envs.base import Env
from brax.envs.base import State as BraxState

from sim2real.composer.mjx.environment import MjxEnvironment


class BraxEnv(Env):
    """Runs a task on MJX with the interface of ``brax.envs``.

    The observation is a vector: the task's observables, one after the other, in their order. ``info["truncation"]`` is
    1 where an episode ended only because of the time limit, ``info["failed"]`` where no initial state was found.

    Args:
        environment: The task as a pure environment.
    """

    def __init__(self, environment: MjxEnvironment) -> None:
        self.environment = environment
        self._size = sum(leaf.size for leaf in environment.observation_spec().values())

    def reset(self, rng: Any) -> BraxState:
        """Return a copy at the start of an episode."""
        return self._state(self.environment.reset(rng), {})

    def step(self, state: BraxState, action: Any) -> BraxState:
        """Return the copy one control step later."""
        return self._state(self.environment.step(state.pipeline_state, action), state.info)  # pyright: ignore[reportArgumentType]

    def _state(self, state: Any, info: dict[str, Any]) -> BraxState:
        values = [jnp.ravel(v) for v in state.observation.values()]
        observation = jnp.concatenate(values) if values else jnp.zeros(0)
        dtype = state.reward.dtype
        found = {"truncation": state.truncated.astype(dtype), "failed": state.failed.astype(dtype)}
        return BraxState(state, observation, state.reward, state.done.astype(dtype), {}, {**info, **found})  # pyright: ignore[reportArgumentType]

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self._size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return int(self.environment.model.nu)

    @property
    def backend(self) -> str:
        """The engine."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions [s]."""
        return self.environment.task.control_timestep
