"""A robot with its delays as a pure environment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from dm_env import specs

from sim2real.errors import UsageError
from sim2real.interop.pure_environment import Transition
from sim2real.policy.contract import PolicyContract
from sim2real.training.environment.graph_environment import EnvState, GraphEnvironment
from sim2real.training.environment.policy_steps import PolicySteps

if TYPE_CHECKING:
    from sim2real.types import Key


@dataclass(frozen=True)
class Entry:
    """One number of an observation or an action.

    Attributes:
        name: E.g. ``past voltage[0][2]``: the term, its age in steps, and the entry of that term.
        unit: ``"1"`` for a number without a unit.
        low: Lower bound [its unit]; infinite where the robot gives none.
        high: Upper bound [its unit].
    """

    name: str
    unit: str
    low: float
    high: float


def entries_of(contract: PolicyContract) -> tuple[tuple[Entry, ...], tuple[Entry, ...]]:
    """Return the entries of a policy's observation, and those of its action."""
    bounds = [
        (unit, low, high)
        for term in contract.observation
        for _ in range(term.history)
        for unit, low, high in zip(
            term.units, term.low or (-math.inf,) * term.size, term.high or (math.inf,) * term.size, strict=True
        )
    ]
    observation = (Entry(name, *rest) for name, rest in zip(contract.observation_names, bounds, strict=True))
    return tuple(observation), tuple(Entry(term.name, term.unit, term.low, term.high) for term in contract.action)


class Copy(NamedTuple):
    """The state of one copy.

    Attributes:
        key: Source of the random numbers in an episode.
        truncated: Whether the time limit has ended the episode.
    """

    env: EnvState
    key: jax.Array
    truncated: jax.Array


class RobotEnvironment:
    """One copy of a robot with its delays; see ``PureEnvironment``.

    Every step is a step of the policy. Every episode has a random timeline of the graph and parameters of its own, and
    is truncated at the end of the timeline. Actions are clipped to their bounds, as the gate does on the robot.

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
        self.period_s = 1.0 / contract.rate_hz
        if len(self.observation) != env.observation_size:
            raise UsageError(
                f"the robot's observation terms have {len(self.observation)} entries, its task shows "
                f"{env.observation_size}",
                hint="give each entry a name and a unit in the robot's `observation`",
            )
        self.observation_spec, self.action_spec = _spec(self.observation), _spec(self.action)

    def reset(self, key: Key) -> Transition[Copy]:
        """Return a copy at the start of an episode."""
        key, next_key = jax.random.split(key)
        state, observation = self.steps.reset(key)
        no, zero = jnp.bool_(False), jnp.float32(0)
        # The values of an episode have the same names as those of a step, so that both have one structure.
        action = jnp.zeros(len(self.action), jnp.float32)
        names = jax.eval_shape(self.steps.step, state, action, key).metrics
        values = {name: zero for name in names}
        return Transition(Copy(state, next_key, no), observation, zero, no, no, {}, values)

    def step(self, state: Copy, action: jax.Array) -> Transition[Copy]:
        """Return the copy after the policy's next step.

        Args:
            action: Shape ``(A,)`` [the action's units].
        """
        key, next_key = jax.random.split(state.key)
        low, high = (jnp.asarray(b, jnp.float32) for b in (self.steps.action_low, self.steps.action_high))
        result = self.steps.step(state.env, jnp.clip(jnp.asarray(action, jnp.float32), low, high), key)
        truncated = result.truncated & ~result.terminated
        reward = jnp.asarray(result.reward, jnp.float32)
        following = Copy(result.state, next_key, truncated)
        return Transition(following, result.observation, reward, result.terminated, truncated, {}, result.metrics)

    def is_truncated(self, state: Copy) -> jax.Array:
        """Return whether the time limit has ended the episode."""
        return state.truncated

    def reseed(self, state: Copy, key: Key) -> Copy:
        """Return a state with random numbers from ``key``."""
        return state._replace(key=key)


def _spec(entries: Sequence[Entry]) -> specs.BoundedArray:
    low, high = np.array([(e.low, e.high) for e in entries], np.float32).T
    return specs.BoundedArray((len(entries),), np.float32, low, high)
