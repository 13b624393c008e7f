"""A composed task, or a robot with its delays, with the interface of ``brax.envs``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from sim2real.composer.mjx_environment import MjxEnvironment
from sim2real.errors import Sim2RealError
from sim2real.installation import with_extra
from sim2real.interop.robot import RobotEnvironment, specs_of
from sim2real.training.environment.protocol import to_vector

try:
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState
except ImportError as error:
    raise Sim2RealError(
        "environments for brax need brax, which is not installed", hint=with_extra("interop")
    ) from error

if TYPE_CHECKING:
    from sim2real.types import Key, PyTree

_FIRST_STATE, _FIRST_OBSERVATION = "first_pipeline_state", "first_obs"
"""Entries from which brax's ``AutoResetWrapper`` starts the next episode."""
_STEPS = "steps"
"""Entry in which brax's ``EpisodeWrapper`` counts the steps of an episode."""


class BraxEnv(Env):
    """A composed task on MJX, or a robot with its delays.

    The observation of a task is a vector of its observables in their order. Actions of a task follow its
    ``action_spec``; actions of a robot go from -1 to 1, for the bounds of ``environment.action``, as brax has no bounds
    of actions. ``info["failed"]`` is 1 if a task drew no acceptable initial state.

    ``info["truncation"]`` is 1 if only the time limit ended an episode. brax's ``EpisodeWrapper`` overwrites this
    entry, and treats ``done`` as a termination. So with this wrapper a time limit does not set ``done``; the wrapper's
    ``episode_length`` ends the episode, as a truncation. It must be at most ``max_episode_length``: the reward is NaN
    beyond the time limit.

    brax's ``AutoResetWrapper`` starts every episode of a copy from the state of its first episode, with the same random
    numbers: all episodes would be equal. This environment replaces that state at every step by a fresh start, drawn
    from ``info["key"]``, which costs a reset in each step.

    ``metrics`` has a robot's ``return`` and ``success`` in the last step of an episode, and 0 in all others.
    """

    def __init__(self, environment: MjxEnvironment | RobotEnvironment) -> None:
        self.environment: PyTree = environment
        observation, action = specs_of(environment)
        shapes = observation.values() if isinstance(observation, Mapping) else [observation]
        self._sizes = sum(math.prod(spec.shape) for spec in shapes), math.prod(action.shape)
        self.max_episode_length = environment.step_limit
        self._middle: PyTree = None
        if isinstance(environment, RobotEnvironment):
            low, high = action.minimum, action.maximum  # pyright: ignore[reportAttributeAccessIssue] - it has bounds
            self._middle, self._half = (high + low) / 2, (high - low) / 2

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
        """The name of the engine, for brax: ``mjx`` means an engine other than brax's."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions [s]."""
        is_robot = isinstance(self.environment, RobotEnvironment)
        return 1.0 / self.environment.rate_hz if is_robot else self.environment.task.control_timestep

    def reset(self, rng: Key) -> BraxState:
        """Return a copy at the start of an episode."""
        rng, key = jax.random.split(rng)
        copy = self.environment.reset(rng)
        return _brax_state(copy, copy.reward, {"key": key}, {})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Return the copy one step later."""
        before: PyTree = state.pipeline_state
        info = {**state.info}
        info["key"], key = jax.random.split(info["key"])
        if _FIRST_STATE in info:
            fresh = self.environment.reset(key)
            info |= {_FIRST_STATE: fresh, _FIRST_OBSERVATION: to_vector(fresh.observation)}
        if self._middle is not None:
            action = self._middle + self._half * jnp.clip(action, -1.0, 1.0)
        copy = self.environment.step(before, action)
        # An episode beyond its time limit must not train a policy unnoticed.
        reward = jnp.where(before.truncated, jnp.nan, copy.reward)
        return _brax_state(copy, reward, info, state.metrics)


def _brax_state(
    copy: PyTree, reward: jax.Array, info: dict[str, jax.Array], metrics: dict[str, jax.Array]
) -> BraxState:
    """Return the state in brax's form, of a task (with a discount) or of a robot (with values of its episode)."""
    dtype = reward.dtype
    done = copy.done & ~copy.truncated if _STEPS in info else copy.done
    info |= {"truncation": copy.truncated.astype(dtype)}
    info |= {n: getattr(copy, n).astype(dtype) for n in ("discount", "failed") if hasattr(copy, n)}
    of_episode = getattr(copy, "values", {})  # keep the metrics that brax's wrappers add
    metrics = metrics | {n: jnp.where(copy.done, v, 0.0) for n, v in of_episode.items()}
    return BraxState(copy, to_vector(copy.observation), reward, done.astype(dtype), metrics, info)
