"""Teachers: policies that observe the simulation's true state, and the checks before a student imitates one."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.runtime.program_arguments import data_of, with_data
from sim2real.train.config import PPOConfig
from sim2real.train.environment.protocol import (
    FollowingEnvironment,
    Step,
    TrainingEnvironment,
    WideningEnvironment,
    require_privileged,
)
from sim2real.train.networks.architectures import is_recurrent
from sim2real.train.networks.policy import Policy
from sim2real.types import PyTree


class TeacherEnvironment:
    """An environment whose observation ends with the privileged entries of the environment inside.

    Raises:
        UsageError: The environment inside has no privileged entries.
    """

    def __init__(self, env: TrainingEnvironment) -> None:
        self._env, self._truth = env, require_privileged(env)
        self.privileged_size = count_privileged(env)
        self.observation_size = env.observation_size + self.privileged_size
        self.action_low, self.action_high = env.action_low, env.action_high
        self.curriculum = env.curriculum if isinstance(env, WideningEnvironment) else None
        self.follow = env.follow if isinstance(env, FollowingEnvironment) else 0.0

    @property
    def data(self) -> PyTree:
        """The environment's data; see ``HoldsData``."""
        return data_of(self._env)

    def with_data(self, data: PyTree) -> TeacherEnvironment:
        """Return a copy of the environment with other data, which may be traced."""
        env = copy.copy(self)
        env._env = with_data(self._env, data)
        env._truth = require_privileged(env._env)
        return env

    def reset(self, key: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the state at the start of an episode and the first observation."""
        state, observation = self._env.reset(key)
        return state, self._extend(state, observation)

    def reset_at(self, key: jax.Array, width: jax.Array) -> tuple[PyTree, jax.Array]:
        """Start an episode with a share, shape ``()``, of the differences between episodes."""
        if not isinstance(self._env, WideningEnvironment):
            return self.reset(key)
        state, observation = self._env.reset_at(key, width)
        return state, self._extend(state, observation)

    def step(self, state: PyTree, action: jax.Array, key: jax.Array) -> Step:
        """Play one row; ``action (A,)`` within the bounds [the action's units]."""
        step = self._env.step(state, action, key)
        return step._replace(observation=self._extend(step.state, step.observation))

    def privileged(self, state: PyTree) -> jax.Array:
        """Return the privileged entries, shape ``(P,)``."""
        return self._truth.privileged(state)

    def _extend(self, state: PyTree, observation: jax.Array) -> jax.Array:
        return jnp.concatenate([observation, self.privileged(state)])


def count_privileged(env: TrainingEnvironment) -> int:
    """Return the number of privileged entries: true in simulation, not measured by a robot."""
    state = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))[0]
    shape = jax.eval_shape(require_privileged(env).privileged, state).shape
    if len(shape) != 1:
        raise UsageError(f"the environment's `privileged` must return a vector, it has shape {shape}")
    return shape[0]


def environment_for(policy: Policy, env: TrainingEnvironment) -> TrainingEnvironment:
    """Return the environment with the observation that a policy expects."""
    return TeacherEnvironment(env) if policy.spec.privileged else env


def advice(env: TrainingEnvironment, teacher: Policy, state: PyTree, observation: jax.Array) -> jax.Array:
    """Return the teacher's action, shape ``(A,)``, within [-1, 1] of the action's range.

    Args:
        observation: Shape ``(O,)``: the student's.
    """
    if teacher.spec.privileged:
        observation = jnp.concatenate([observation, require_privileged(env).privileged(state)])
    return teacher.bound(teacher.get_mean(teacher.initial_carry(), observation)[1])


def check_teacher(env: TrainingEnvironment, config: PPOConfig, teacher: Policy) -> None:
    """Compare a teacher with the student's environment."""
    # Refuse a teacher for a teacher, and one with memory.
    privileged = count_privileged(env) if teacher.spec.privileged else 0
    if config.teacher:
        raise UsageError(
            "a student observes only what a robot measures, not the simulation's true state",
            hint="train it without --ppo.teacher",
        )
    if is_recurrent(teacher.network):
        raise UsageError(
            f"a teacher of network {teacher.spec.name!r} remembers, and the student leads to states that the teacher "
            "has no memory of",
            hint="train the teacher with --ppo.network mlp: it observes the true state and need not remember",
        )
    # Compare observations and bounds.
    sizes = (teacher.mean.size, teacher.spec.privileged), (env.observation_size + privileged, privileged)
    bounds = [np.asarray(a, np.float32) for a in (teacher.low, teacher.high, env.action_low, env.action_high)]
    if sizes[0] != sizes[1] or not np.array_equal(bounds[:2], bounds[2:]):
        raise UsageError(
            f"the teacher observes {sizes[0][0]} entries, {sizes[0][1]} of them in simulation only, and acts within "
            f"{bounds[0]} to {bounds[1]}; here it is {sizes[1][0]}, {sizes[1][1]}, {bounds[2]} and {bounds[3]}",
            hint="train the teacher on this robot in this world",
        )
