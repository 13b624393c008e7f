"""A pure environment with the interface of ``brax.envs``."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sim2real.composer.interop.moment import Moment, PureEnvironment
from sim2real.errors import Sim2RealError

try:
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState
except ImportError as error:
    raise Sim2RealError(
        "environments for brax need brax, which is not installed", hint="pip install 'sim2real[interop]'"
    ) from error

_FIRST_STATE, _FIRST_OBSERVATION = "first_pipeline_state", "first_obs"
"""Where brax's ``AutoResetWrapper`` keeps what an episode that is over goes on from."""
_STEPS = "steps"
"""Where brax's ``EpisodeWrapper`` counts the steps of an episode."""


class PureBraxEnv(Env):
    """A pure environment whose observation is a vector.

    ``info["truncation"]`` is 1 where an episode ended only because of the time limit. brax's ``EpisodeWrapper`` writes
    that entry anew: to it, whoever says ``done`` means a termination. So under that wrapper a time limit does not set
    ``done``; the wrapper's own ``episode_length`` ends the episode, as a truncation. It must be at most
    ``max_episode_length``: an episode that goes on past its time limit gets NaN as reward.

    brax's ``AutoResetWrapper`` starts every episode of a copy from the state that its first one started from, random
    numbers included: all episodes would be the same. This environment puts a fresh start in that place at every step,
    drawn from ``info["key"]``, which goes on from episode to episode. That costs a reset a step.

    ``metrics`` has the values of whole episodes, in the step that ends them, and 0 in all others.

    Args:
        sizes: Lengths of an observation and of an action.
        dt_s: Time between two actions [s].
        max_episode_length: Steps until the time limit; None: there is none.
        fresh_starts: Whether it does; else only the randomness inside of episodes differs, and a step costs a step.
    """

    def __init__(
        self,
        pure: PureEnvironment,
        sizes: tuple[int, int],
        dt_s: float,
        max_episode_length: int | None,
        fresh_starts: bool = True,
    ) -> None:
        self._pure, self._sizes, self._dt_s, self._fresh_starts = pure, sizes, dt_s, fresh_starts
        self.max_episode_length = max_episode_length

    def reset(self, rng: jax.Array) -> BraxState:
        """Return a copy at the start of an episode."""
        rng, key = jax.random.split(rng)
        moment = self._pure.reset(rng)
        return self._state(moment, moment.reward, {"key": key}, {})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Return the copy one step later."""
        before: Any = state.pipeline_state
        info = {**state.info}
        info["key"], key = jax.random.split(info["key"])
        if not self._fresh_starts:  # an episode that starts from the same state goes on with numbers of its own
            before = self._pure.reseed(before, key)
        elif _FIRST_STATE in info:
            fresh = self._pure.reset(key)
            info |= {_FIRST_STATE: fresh.state, _FIRST_OBSERVATION: fresh.observation}
        moment = self._pure.step(before, action)
        past = self._pure.cut(before)
        return self._state(moment, jnp.where(past, jnp.nan, moment.reward), info, state.metrics)

    def _state(self, moment: Moment, reward: jax.Array, info: dict[str, Any], metrics: dict[str, Any]) -> BraxState:
        dtype = reward.dtype
        ended = moment.terminated | moment.truncated
        done = moment.terminated if _STEPS in info else ended
        info |= {"truncation": moment.truncated.astype(dtype)}
        info |= {name: value.astype(dtype) for name, value in moment.info.items()}
        # brax's wrappers have metrics of their own, which stay.
        metrics = metrics | {name: jnp.where(ended, value, 0.0) for name, value in moment.ending.items()}
        return BraxState(moment.state, moment.observation, reward, done.astype(dtype), metrics, info)

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self._sizes[0]

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self._sizes[1]

    @property
    def backend(self) -> str:
        """The engine, as brax calls it: ``mjx`` stands for one that is not brax's own."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions [s]."""
        return self._dt_s
