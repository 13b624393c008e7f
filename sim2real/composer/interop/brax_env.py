"""A composed task as a brax environment."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from sim2real.composer.mjx.environment import MjxEnvironment, State
from sim2real.errors import Sim2RealError

try:
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState
except ImportError as error:
    raise Sim2RealError("BraxEnv needs brax, which is not installed", hint="pip install 'sim2real[interop]'") from error

_FIRST_STATE, _FIRST_OBSERVATION = "first_pipeline_state", "first_obs"
"""Where brax's ``AutoResetWrapper`` keeps what an episode that is over goes on from."""


class BraxEnv(Env):
    """Runs a task on MJX with the interface of ``brax.envs``.

    The observation is a vector: the task's observables, one after the other, in their order. ``info["truncation"]`` is
    1 where an episode ended only because of the time limit, ``info["failed"]`` where no initial state was found.

    brax's ``AutoResetWrapper`` starts every episode of a copy from the state that its first one started from, random
    numbers included: all episodes would be the same. This environment puts a fresh start in that place at every step,
    drawn from ``info["key"]``, which goes on from episode to episode. That costs a reset a step.

    Args:
        environment: The task as a pure environment.
        fresh_starts: Whether it does; else only the randomness inside of episodes differs, and a step costs a step.
    """

    def __init__(self, environment: MjxEnvironment, fresh_starts: bool = True) -> None:
        self.environment, self._fresh_starts = environment, fresh_starts
        self._size = sum(leaf.size for leaf in environment.observation_spec().values())

    def reset(self, rng: jax.Array) -> BraxState:
        """Return a copy at the start of an episode."""
        rng, key = jax.random.split(rng)
        return self._state(self.environment.reset(rng), {"key": key})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Return the copy one control step later."""
        before: Any = state.pipeline_state
        info = {**state.info}
        info["key"], key = jax.random.split(info["key"])
        if not self._fresh_starts:  # an episode that starts from the same state goes on with numbers of its own
            before = before.replace(key=self.environment.select(before.steps == 0, key, before.key))
        elif _FIRST_STATE in info:
            fresh = self.environment.reset(key)
            info |= {_FIRST_STATE: fresh, _FIRST_OBSERVATION: _observed(fresh)}
        return self._state(self.environment.step(before, action), info)

    def _state(self, state: Any, info: dict[str, Any]) -> BraxState:
        dtype = state.reward.dtype
        info |= {"truncation": state.truncated.astype(dtype), "failed": state.failed.astype(dtype)}
        return BraxState(state, _observed(state), state.reward, state.done.astype(dtype), {}, info)

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self._size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return math.prod(self.environment.action_spec().shape)

    @property
    def backend(self) -> str:
        """The engine."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions [s]."""
        return self.environment.task.control_timestep


def _observed(state: State) -> jax.Array:
    values = [jnp.ravel(v) for v in state.observation.values()]
    return jnp.concatenate(values) if values else jnp.zeros(0)
