"""A robot with its delays, as pure functions of one copy that the adapters to other libraries take."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sim2real.composer.interop.moment import Moment
from sim2real.errors import UsageError
from sim2real.interop.entries import entries_of
from sim2real.policy.contract import PolicyContract
from sim2real.train.environment.graph_environment import GraphEnvironment
from sim2real.train.environment.policy_steps import PolicySteps


class Copy(NamedTuple):
    """The state of one copy.

    Attributes:
        env: The environment's.
        key: Source of what is random in an episode.
        cut: Whether the time limit has ended the episode.
    """

    env: Any
    key: jax.Array
    cut: jax.Array


class RobotEnvironment:
    """One copy of a robot with its delays; see ``sim2real.composer.interop.moment.PureEnvironment``.

    Every step is one of the policy's, and every episode has a random one of the graph's timelines, and its own
    parameters. An episode is truncated where its timeline ends. Actions are clipped to their bounds, as the gate does
    on the robot.

    Attributes:
        observation: The entries of an observation, in order.
        action: The entries of an action, in order.
        rate_hz: The policy's steps per second [Hz].
        length: Largest number of steps of an episode.

    Raises:
        UsageError: When the contract has another number of entries than the environment.
    """

    def __init__(self, env: GraphEnvironment, contract: PolicyContract) -> None:
        self.steps = PolicySteps(env)
        self.observation, self.action = entries_of(contract)
        self.rate_hz, self.length = contract.rate_hz, self.steps.length
        if len(self.observation) != env.observation_size:
            raise UsageError(
                f"the robot's observation terms have {len(self.observation)} entries, its task shows "
                f"{env.observation_size}",
                hint="give each entry a name and a unit in the robot's `observation`",
            )

    def reset(self, key: jax.Array) -> Moment:
        """Return a copy at the start of an episode."""
        key, own = jax.random.split(key)
        state, observation = self.steps.reset(key)
        no = jnp.bool_(False)
        zero = jnp.float32(0)
        idle = jnp.zeros(len(self.action), jnp.float32)
        ending = {name: zero for name in jax.eval_shape(self.steps.step, state, idle, key).metrics}
        return Moment(Copy(state, own, no), observation, zero, no, no, {}, ending)

    def step(self, state: Copy, action: jax.Array) -> Moment:
        """Return the copy after the policy's next step.

        Args:
            action: Shape ``(A,)`` [the action's units].
        """
        key, own = jax.random.split(state.key)
        low, high = (jnp.asarray(b, jnp.float32) for b in (self.steps.action_low, self.steps.action_high))
        made = self.steps.step(state.env, jnp.clip(jnp.asarray(action, jnp.float32), low, high), key)
        cut = made.truncated & ~made.terminated
        reward = jnp.asarray(made.reward, jnp.float32)
        return Moment(Copy(made.state, own, cut), made.observation, reward, made.terminated, cut, {}, made.metrics)

    def cut(self, state: Copy) -> jax.Array:
        """Return whether the time limit has ended the episode."""
        return state.cut

    def reseed(self, state: Copy, key: jax.Array) -> Copy:
        """Return a state whose random numbers go on from ``key``."""
        return state._replace(key=key)
