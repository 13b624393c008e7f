"""A teacher, a policy that sees what only simulation knows, and what a student of it needs."""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.runtime.program_arguments import data_of, with_data
from sim2real.train.config import PPOConfig
from sim2real.train.environment.protocol import Step, TrainingEnvironment, WideningEnvironment, sees_more
from sim2real.train.networks.architectures import is_recurrent
from sim2real.train.networks.policy import Policy


class TeacherEnvironment:
    """An environment whose policy sees, after its observation, what is true in simulation.

    Raises:
        UsageError: It does not say what is true.
    """

    def __init__(self, env: TrainingEnvironment) -> None:
        self._env, self._knows = env, sees_more(env)
        self.privileged_size = size_of(env)
        self.observation_size = env.observation_size + self.privileged_size
        self.action_low, self.action_high = env.action_low, env.action_high
        self.curriculum = env.curriculum if isinstance(env, WideningEnvironment) else None

    @property
    def data(self) -> Any:
        """The environment's data; see ``HoldsData``."""
        return data_of(self._env)

    def with_data(self, data: Any) -> TeacherEnvironment:
        """Return a copy of the environment with other data, which may be traced."""
        env = copy.copy(self)
        env._env = with_data(self._env, data)
        env._knows = sees_more(env._env)
        return env

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """Return the state at the start of an episode and the first observation."""
        state, observation = self._env.reset(key)
        return state, self._seen(state, observation)

    def reset_at(self, key: jax.Array, width: jax.Array) -> tuple[Any, jax.Array]:
        """Start an episode that differs from others by a share, shape ``()``, of what it might."""
        if not isinstance(self._env, WideningEnvironment):
            return self.reset(key)
        state, observation = self._env.reset_at(key, width)
        return state, self._seen(state, observation)

    def step(self, state: Any, action: jax.Array, key: jax.Array) -> Step:
        """Play one row.

        Args:
            state: What ``reset`` or ``step`` returned.
            action: Shape ``(A,)``, within the bounds [the action's units].
        """
        made = self._env.step(state, action, key)
        return made._replace(observation=self._seen(made.state, made.observation))

    def privileged(self, state: Any) -> jax.Array:
        """Return what is true in a state, shape ``(P,)``."""
        return self._knows.privileged(state)

    def _seen(self, state: Any, observation: jax.Array) -> jax.Array:
        return jnp.concatenate([observation, self.privileged(state)])


def size_of(env: TrainingEnvironment) -> int:
    """Return how many entries are true in simulation and unknown to a robot.

    Raises:
        UsageError: The environment does not say what is true.
    """
    state = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))[0]
    shape = jax.eval_shape(sees_more(env).privileged, state).shape
    if len(shape) != 1:
        raise UsageError(f"what the environment's `privileged` returns must be a vector, it has shape {shape}")
    return shape[0]


def seen_by(policy: Policy, env: TrainingEnvironment) -> TrainingEnvironment:
    """Return the environment as a policy sees it."""
    return TeacherEnvironment(env) if policy.spec.privileged else env


def advice(env: TrainingEnvironment, teacher: Policy, state: Any, observation: jax.Array) -> jax.Array:
    """Return what a teacher would do, shape ``(A,)``, within [-1, 1] of the action's range.

    Args:
        observation: Shape ``(O,)``: what the student sees.
    """
    if teacher.spec.privileged:
        observation = jnp.concatenate([observation, sees_more(env).privileged(state)])
    return teacher.bound(teacher.get_mean(teacher.initial_carry(), observation)[1])


def check_teacher(env: TrainingEnvironment, config: PPOConfig, teacher: Policy) -> None:
    """Compare a teacher with what it shall teach in.

    Raises:
        UsageError: It is none for this student; the message says in what.
    """
    known = size_of(env) if teacher.spec.privileged else 0
    if config.teacher:
        raise UsageError(
            "a student sees what a robot shows, not what only simulation knows", hint="train it without --ppo.teacher"
        )
    if is_recurrent(teacher.network):
        raise UsageError(
            f"a teacher of network {teacher.spec.name!r} remembers; here it is asked in states that it did not lead to",
            hint="train the teacher with --ppo.network mlp: it sees the truth and need not remember",
        )
    sizes = (teacher.mean.size, teacher.spec.privileged), (env.observation_size + known, known)
    bounds = [np.asarray(a, np.float32) for a in (teacher.low, teacher.high, env.action_low, env.action_high)]
    if sizes[0] != sizes[1] or not np.array_equal(bounds[:2], bounds[2:]):
        raise UsageError(
            f"the teacher sees {sizes[0][0]} entries, {sizes[0][1]} of them in simulation only, and acts within "
            f"{bounds[0]} to {bounds[1]}; here it is {sizes[1][0]}, {sizes[1][1]}, {bounds[2]} and {bounds[3]}",
            hint="train the teacher on this robot in this world",
        )
