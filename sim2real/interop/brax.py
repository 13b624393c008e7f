"""Pure environments with the interface of ``brax.envs``: composed tasks, and robots with their delays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.physics.mjx.environment import MjxEnvironment
from sim2real.errors import Sim2RealError
from sim2real.installation import with_extra
from sim2real.interop.environments import PureEnvironment, PureTask, RobotEnvironment, Transition

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


class PureBraxEnv(Env):
    """A pure environment whose observation is a vector.

    ``info["truncation"]`` is 1 where only the time limit ended an episode. brax's ``EpisodeWrapper`` overwrites that
    entry, and takes ``done`` for a termination. So under that wrapper a time limit does not set ``done``; the wrapper's
    own ``episode_length`` ends the episode, as a truncation. It must be at most ``max_episode_length``: the reward is
    NaN past the time limit.

    brax's ``AutoResetWrapper`` starts every episode of a copy from the state of its first one, random numbers included:
    all episodes would be the same. This environment replaces that state at every step by a fresh start, drawn from
    ``info["key"]``. That costs a reset a step.

    ``metrics`` has the values of a whole episode in its last step, and 0 in all others.
    """

    def __init__(self, pure: PureEnvironment) -> None:
        if isinstance(pure.observation_spec, Mapping):
            raise TypeError("brax takes observations that are one vector, this environment has a dictionary")
        self._pure = pure
        self._sizes = math.prod(pure.observation_spec.shape), math.prod(pure.action_spec.shape)
        self.max_episode_length = pure.length

    def reset(self, rng: Key) -> BraxState:
        """Return a copy at the start of an episode."""
        rng, key = jax.random.split(rng)
        transition = self._pure.reset(rng)
        return self._brax_state(transition, transition.reward, {"key": key}, {})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Return the copy one step later."""
        before: PyTree = state.pipeline_state
        info = {**state.info}
        info["key"], key = jax.random.split(info["key"])
        if _FIRST_STATE in info:
            fresh = self._pure.reset(key)
            info |= {_FIRST_STATE: fresh.state, _FIRST_OBSERVATION: fresh.observation}
        transition = self._pure.step(before, action)
        # An episode that goes on past its time limit must not train a policy without notice.
        reward = jnp.where(before.truncated, jnp.nan, transition.reward)
        return self._brax_state(transition, reward, info, state.metrics)

    def _brax_state(
        self,
        transition: Transition,
        reward: jax.Array,
        info: dict[str, jax.Array],
        metrics: dict[str, jax.Array],
    ) -> BraxState:
        dtype = reward.dtype
        ended = transition.terminated | transition.truncated
        done = transition.terminated if _STEPS in info else ended
        info |= {"truncation": transition.truncated.astype(dtype)}
        info |= {name: value.astype(dtype) for name, value in transition.info.items()}
        # brax's wrappers add metrics of their own, which stay.
        metrics = metrics | {n: jnp.where(ended, v, 0.0) for n, v in transition.episode_values.items()}
        return BraxState(transition.state, transition.observation, reward, done.astype(dtype), metrics, info)

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
        """The engine, in brax's terms: ``mjx`` means an engine other than brax's."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions [s]."""
        return self._pure.period_s


class BraxEnv(PureBraxEnv):
    """Runs a task on MJX with the interface of ``brax.envs``; see ``PureBraxEnv`` for episodes and their ends.

    The observation is a vector: the task's observables, one after the other, in their order. Actions follow the task's
    ``action_spec``. ``info["failed"]`` is 1 where no acceptable initial state was drawn.
    """

    def __init__(self, environment: MjxEnvironment) -> None:
        self.environment = environment
        super().__init__(PureTask(environment, flat=True))


class RobotBraxEnv(PureBraxEnv):
    """One robot with its delays, with the interface of ``brax.envs``; see ``PureBraxEnv`` for episodes and their ends.

    brax has no bounds of actions; its learners send values between -1 and 1. Here an action of -1 stands for the lower
    bound of ``robot.action`` and 1 for the upper one. ``metrics`` has an episode's ``return`` and ``success``.

    Attributes:
        robot: One copy; ``robot.observation`` and ``robot.action`` name each entry, with unit and bounds.
    """

    def __init__(self, robot: RobotEnvironment) -> None:
        self.robot = robot
        low, high = np.array([(e.low, e.high) for e in robot.action], np.float32).T
        self._middle, self._half = (high + low) / 2, (high - low) / 2
        super().__init__(robot)

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Return the copy after the policy's next step.

        Args:
            action: Shape ``(A,)``, from -1 to 1.
        """
        return super().step(state, self._middle + self._half * jnp.clip(action, -1.0, 1.0))
