"""One copy of an environment as pure functions, to which the adapters apply ``vmap``: a robot, or a composed task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from dm_env import specs

from sim2real.composer.physics.mjx.environment import MjxEnvironment, State
from sim2real.errors import UsageError
from sim2real.policy.contract import PolicyContract
from sim2real.training.environment.graph_environment import EnvState, GraphEnvironment
from sim2real.training.environment.protocol import Step, choose

if TYPE_CHECKING:
    from sim2real.types import Key, PyTree


class Transition(NamedTuple):
    """One copy after a reset or a step.

    Attributes:
        state: A pytree of arrays; ``state.truncated`` tells whether a time limit has ended the episode.
        observation: An array, or a dictionary of arrays.
        reward: Shape ``()``; 0 after a reset.
        terminated: Shape ``()``, bool: the task ended the episode.
        truncated: Shape ``()``, bool: a time limit ended the episode. Never true together with ``terminated``.
        info: Name -> array: further values of the step.
        episode_values: Name -> shape ``()``: values of the whole episode, valid only in its last step.
    """

    state: PyTree
    observation: PyTree
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, jax.Array]
    episode_values: dict[str, jax.Array]


class PureEnvironment(Protocol):
    """One copy of an environment.

    Attributes:
        period_s: Time between two actions [s].
        length: Largest number of steps of an episode; None: no time limit.
    """

    period_s: float
    length: int | None

    @property
    def observation_spec(self) -> specs.Array | Mapping[str, specs.Array]:
        """Shapes, dtypes and bounds of an observation."""
        ...

    @property
    def action_spec(self) -> specs.Array:
        """Shape, dtype and bounds of an action."""
        ...

    def reset(self, key: Key) -> Transition:
        """Return a copy at the start of an episode."""
        ...

    def step(self, state: PyTree, action: jax.Array) -> Transition:
        """Return the copy one step later."""
        ...


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
    """The state of one copy of a robot.

    Attributes:
        key: Source of the random numbers in an episode.
        truncated: Whether the time limit has ended the episode.
    """

    env: EnvState
    key: jax.Array
    truncated: jax.Array


class RobotEnvironment:
    """One copy of a robot with its delays.

    Every step is a step of the policy. A row of the graph in which the policy makes none (it paused, or its rate does
    not divide the world's) belongs to the policy's step before it: its reward is added to that step's, and the
    observation is that of the next step. Every episode has a random timeline of the graph and parameters of its own. It
    is truncated at the policy's last step in the timeline, whose observation is the final one. Actions are clipped to
    their bounds, as the gate does on the robot.

    Attributes:
        env: The environment of the graph's rows.
        observation: The entries of an observation, in order.
        action: The entries of an action, in order.
        rate_hz: The policy's steps per second [Hz].
        length: Largest number of steps of an episode.

    Raises:
        UsageError: The contract has another number of entries than the environment, or the policy makes fewer than two
            steps in a timeline.
    """

    def __init__(self, env: GraphEnvironment, contract: PolicyContract) -> None:
        self.env = env
        self.observation, self.action = entries_of(contract)
        self.rate_hz, self.period_s = contract.rate_hz, 1.0 / contract.rate_hz
        if len(self.observation) != env.observation_size:
            raise UsageError(
                f"the robot's observation terms have {len(self.observation)} entries, its task shows "
                f"{env.observation_size}",
                hint="give each entry a name and a unit in the robot's `observation`",
            )
        self.observation_spec, self.action_spec = _spec(self.observation), _spec(self.action)
        # The rows in which the policy makes a step, `(E, R)`.
        turns = env.graph.turns
        if (turns.sum(axis=1) < 2).any():
            raise UsageError(
                f"the policy {env.task.supervisor!r} makes fewer than two steps in a timeline",
                hint="draw longer timelines",
            )
        self.length: int | None = int(turns.sum(axis=1).max()) - 1
        self._last = turns.shape[1] - 1 - np.argmax(turns[:, ::-1], axis=1)
        self._rows_before = int(np.argmax(turns, axis=1).max())
        self._rows_between = max(int(np.diff(np.flatnonzero(t)).max()) for t in turns) - 1

    def reset(self, key: Key) -> Transition:
        """Return a copy at the start of an episode, at the policy's first step."""
        key, next_key = jax.random.split(key)
        idle = jnp.asarray(self.env.action_low, jnp.float32)

        def play(now: tuple[EnvState, jax.Array], _: None) -> tuple[tuple[EnvState, jax.Array], None]:
            row = self.env.step(now[0], idle, key)
            # The policy has not acted yet: rewards so far are no part of the episode's return.
            state = row.state._replace(total=now[0].total, good=now[0].good)
            return choose(jnp.asarray(now[0].step_state.seq >= 0), now, (state, row.observation)), None

        state, observation = jax.lax.scan(play, self.env.reset(key), length=self._rows_before)[0]
        # The values of an episode have the same names as those of a step, so that both have one structure.
        no, zero = jnp.bool_(False), jnp.float32(0)
        values = {name: zero for name in jax.eval_shape(self.env.step, state, idle, key).metrics}
        return Transition(Copy(state, next_key, no), observation, zero, no, no, {}, values)

    def step(self, state: Copy, action: jax.Array) -> Transition:
        """Return the copy at the policy's next step, after ``action (A,)`` [its units]."""
        key, next_key = jax.random.split(state.key)
        action = jnp.clip(jnp.asarray(action, jnp.float32), self.env.action_low, self.env.action_high)

        def row(env_state: EnvState) -> Step:
            made = self.env.step(env_state, action, key)
            over = made.state.graph.step >= jnp.asarray(self._last)[made.state.graph.eps]
            return made._replace(truncated=made.truncated | over)

        def play(now: Step, _: None) -> tuple[Step, None]:
            following = row(now.state)
            following = following._replace(reward=now.reward + following.reward)
            over = now.terminated | now.truncated | (now.state.step_state.seq >= 0)
            return choose(over, now, following), None

        made = jax.lax.scan(play, row(state.env), length=self._rows_between)[0]
        truncated = made.truncated & ~made.terminated
        reward, following = jnp.asarray(made.reward, jnp.float32), Copy(made.state, next_key, truncated)
        return Transition(following, made.observation, reward, made.terminated, truncated, {}, made.metrics)


class PureTask:
    """One copy of a composed task on MJX.

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

    def reset(self, key: Key) -> Transition:
        return self._transition(self.environment.reset(key))

    def step(self, state: State, action: jax.Array) -> Transition:
        return self._transition(self.environment.step(state, action))

    def _transition(self, state: State) -> Transition:
        observation = state.observation
        if self._flat:
            observation = jnp.concatenate([jnp.ravel(v) for v in observation.values()])
        info = {"discount": state.discount, "failed": state.failed}
        terminated = state.done & ~state.truncated
        return Transition(state, observation, state.reward, terminated, state.truncated, info, {})


def _spec(entries: Sequence[Entry]) -> specs.BoundedArray:
    low, high = np.array([(e.low, e.high) for e in entries], np.float32).T
    return specs.BoundedArray((len(entries),), np.float32, low, high)
