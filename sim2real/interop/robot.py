"""One copy of a robot with its delays as pure functions, like ``MjxEnvironment`` of a composed task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from dm_env import specs

from sim2real.composer.mjx_environment import MjxEnvironment
from sim2real.errors import UsageError
from sim2real.policy.contract import ActionTerm, PolicyContract
from sim2real.training.environment.graph_environment import EnvState, GraphEnvironment
from sim2real.training.environment.protocol import Step, choose

if TYPE_CHECKING:
    from sim2real.types import Key, PyTree


class Entry(NamedTuple):
    """One number of an observation.

    Attributes:
        name: E.g. ``past voltage[0][2]``: the term, its age in steps, and the entry of that term.
        unit: ``"1"`` for a number without a unit.
        low: Lower bound [its unit]; infinite if the robot has none.
        high: Upper bound [its unit].
    """

    name: str
    unit: str
    low: float
    high: float


class Copy(NamedTuple):
    """The state of one copy of a robot, with the results of its last step; named as in a composed task's state.

    Attributes:
        key: Source of the random numbers in an episode.
        done: Whether the task or the time limit has ended the episode.
        truncated: Whether only the time limit has ended it.
        values: Name -> values of the whole episode, valid in its last step.
    """

    env: EnvState
    key: jax.Array
    observation: jax.Array
    reward: jax.Array
    done: jax.Array
    truncated: jax.Array
    values: dict[str, jax.Array]


class RobotEnvironment:
    """One copy of a robot with its delays.

    Every step is a step of the policy. A row of the graph without a step of the policy (it paused, or its rate does not
    divide the world's) belongs to the policy's previous step: its reward is added to that step's reward, and the
    observation is the next step's. Every episode has a random timeline of the graph and random parameters. It is
    truncated at the policy's last step in the timeline, whose observation is the final one. Actions are clipped to
    their bounds, as by the gate on the robot.

    Attributes:
        env: The environment of the graph's rows.
        observation: The entries of an observation, in order.
        action: The entries of an action, in order.
        rate_hz: The policy's steps per second [Hz].
        step_limit: Largest number of steps of an episode.

    Raises:
        UsageError: The contract has another number of entries than the environment, or the policy makes fewer than two
            steps in a timeline.
    """

    def __init__(self, env: GraphEnvironment, contract: PolicyContract) -> None:
        self.env, self.rate_hz = env, contract.rate_hz
        names, entries = iter(contract.observation_names), []
        for term in contract.observation:
            low, high = term.low or (-math.inf,) * term.size, term.high or (math.inf,) * term.size
            numbers = list(zip(term.units, low, high, strict=True))
            entries += [Entry(next(names), *number) for _ in range(term.history) for number in numbers]
        self.observation = tuple(entries)
        self.action = contract.action
        if len(self.observation) != env.observation_size:
            raise UsageError(
                f"the robot's observation terms have {len(self.observation)} entries, its task has "
                f"{env.observation_size}",
                hint="give each entry a name and a unit in the robot's `observation`",
            )
        # The rows in which the policy makes a step, `(E, R)`.
        turns = env.graph.turns
        if (turns.sum(axis=1) < 2).any():
            raise UsageError(
                f"the policy {env.task.supervisor!r} makes fewer than two steps in a timeline",
                hint="draw longer timelines",
            )
        self.step_limit = int(turns.sum(axis=1).max()) - 1
        self._last = turns.shape[1] - 1 - np.argmax(turns[:, ::-1], axis=1)
        self._rows_before = int(np.argmax(turns, axis=1).max())
        self._rows_between = max(int(np.diff(np.flatnonzero(t)).max()) for t in turns) - 1

    def observation_spec(self) -> specs.BoundedArray:
        """Return shape, dtype and bounds of an observation."""
        return _bounded(self.observation)

    def action_spec(self) -> specs.BoundedArray:
        """Return shape, dtype and bounds of an action."""
        return _bounded(self.action)

    def reset(self, key: Key) -> Copy:
        """Return a copy at the start of an episode, at the policy's first step."""
        key, next_key = jax.random.split(key)
        idle = jnp.asarray(self.env.action_low, jnp.float32)

        def play(now: tuple[EnvState, jax.Array], _: None) -> tuple[tuple[EnvState, jax.Array], None]:
            row = self.env.step(now[0], idle, key)
            # The policy has not acted yet: rewards so far do not belong to the episode's return.
            state = row.state._replace(total=now[0].total, good=now[0].good)
            return choose(jnp.asarray(now[0].step_state.seq >= 0), now, (state, row.observation)), None

        state, observation = jax.lax.scan(play, self.env.reset(key), length=self._rows_before)[0]
        no, zero = jnp.bool_(False), jnp.float32(0)
        values = {name: zero for name in jax.eval_shape(self.env.step, state, idle, key).metrics}
        return Copy(state, next_key, observation, zero, no, no, values)

    def step(self, state: Copy, action: jax.Array) -> Copy:
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
        ends = made.terminated | made.truncated, made.truncated & ~made.terminated
        return Copy(made.state, next_key, made.observation, jnp.asarray(made.reward, jnp.float32), *ends, made.metrics)


def specs_of(environment: MjxEnvironment | RobotEnvironment) -> tuple[PyTree, specs.Array]:
    """Return shape, dtype and bounds of an observation, of a composed task by name, and of an action.

    Raises:
        UsageError: No observable of a task is enabled, or an action is not one array.
    """
    observation, action = environment.observation_spec(), environment.action_spec()
    if isinstance(environment, MjxEnvironment) and not observation:
        task = environment.task
        raise UsageError(
            f"task {type(task).__name__} has no observation: no observable is enabled. Available: "
            f"{', '.join(map(repr, task.observables)) or 'none'}",
            hint="set `enabled = True` for the observables of the policy; a robot with its delays comes from "
            "sim2real.interop",
        )
    if not isinstance(action, specs.Array):
        raise UsageError(
            f"an action must be one array, and the task's action_spec is {action!r}",
            hint="override action_spec in the task",
        )
    return observation, action


def _bounded(entries: Sequence[Entry | ActionTerm]) -> specs.BoundedArray:
    low, high = np.array([(e.low, e.high) for e in entries], np.float32).T
    return specs.BoundedArray((len(entries),), np.float32, low, high)
