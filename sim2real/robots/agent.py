"""The policy's node: makes observations from measurements and a short history, and commands from actions.

``observe`` and ``act`` compute with the type of their arguments: JAX in a compiled graph; numpy on the wall clock,
where calls of JAX for small arrays would take longer than the policy.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Unpack

import numpy as np

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.robots.loop import SENSOR
from sim2real.robots.messages import Decision, EpisodeStart, JointReading
from sim2real.types import Array, Key, PyTree, Scalar


@pytree.dataclass
class AgentParams(Base):
    """The agent's parameters for an episode.

    Attributes:
        policy: A pytree with ``get_action(observation)``, or, if it has memory, with ``initial_carry()`` and
            ``step(carry, observation)``; None: actions of 0.
        aim: Shape ``(k,)``: the task's aim in this episode, e.g. a target [the task's units].
        start: Shape ``(joints,)``: commands at the start, such as goals [rad].
    """

    policy: PyTree = None
    aim: PyTree = None
    start: PyTree = None

    @classmethod
    def of(cls, start: EpisodeStart, policy: PyTree = None) -> AgentParams:
        """Return the parameters of an episode with a start."""
        command = start.position if start.command is None else start.command
        return cls(policy, start.aim, namespace(command).asarray(command, np.float32))


@pytree.dataclass
class AgentState(Base):
    """The agent's state.

    Attributes:
        command: Shape ``(n,)``: the last command, such as goals [rad].
        last: Shape ``(actions,)``: the last action.
        before: Shape ``(actions,)``: the action before ``last``.
        past: Shape ``(history, row)``: the last steps, newest first.
        carry: State of a policy with memory.
    """

    command: Array
    last: Array
    before: Array
    past: Array
    carry: PyTree = ()


class PolicyAgent(BaseNode):
    """The policy's node; subclasses define the observation, the command of an action, and the history's rows.

    The observation has the present features, then the history, column by column, each with the newest step first.

    Args:
        actions: Number of actions, and of commands.
        columns: Widths of the parts of a row of the history.
        aims: Number of random numbers of an episode that determine the aim.
        at: Returns the aim for these numbers and a time [s]; None: the numbers are the aim.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        actions: int,
        history: int,
        columns: Sequence[int],
        aims: int = 0,
        at: Callable[[Array, Scalar], Array] | None = None,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._actions, self._history, self._ends = actions, history, np.cumsum([0, *columns]).tolist()
        self._aims, self._at = aims, at

    @abstractmethod
    def features(self, reading: PyTree, step_state: StepState) -> Array:
        """Return the present features, ``(features,)``."""

    def command(self, before: Array, action: Array) -> Array:
        """Return the command ``(n,)`` of an action ``(actions,)``; default: the action."""
        return action

    def row(self, reading: PyTree, features: Array, command: Array, action: Array) -> Array:
        """Return the step's row of the history, ``(row,)``; default: the features."""
        return features

    def shown(self, features: Array, step_state: StepState) -> Array:
        """Return the part of the observation before the history; default: the features."""
        return features

    def aim(self, step_state: StepState) -> Array:
        """Return the aim ``(k,)`` at the step's scheduled time, on the robot as in simulation."""
        aim = step_state.params.aim
        return aim if self._at is None else self._at(aim, step_state.seq / self.rate)

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        return AgentParams(aim=np.zeros(self._aims, np.float32), start=np.zeros(self._actions, np.float32))

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentState:
        params = self._params(graph_state)
        past, still = np.zeros((self._history, self._ends[-1]), np.float32), np.zeros(self._actions, np.float32)
        carry = params.policy.initial_carry() if hasattr(params.policy, "initial_carry") else ()
        return AgentState(namespace(params.start).asarray(params.start, np.float32), still, still, past, carry)

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> Decision:
        params = self._params(graph_state)
        start = namespace(params.start).asarray(params.start, np.float32)
        return self._decision(start, StepState(params=params, seq=0))

    def observe(self, step_state: StepState) -> Array:
        """Return the policy's observation."""
        past = step_state.state.past
        shown = self.shown(self._now(step_state), step_state)
        xp = namespace(shown, past)
        parts = [past[:, a:b].ravel() for a, b in zip(self._ends, self._ends[1:], strict=False)]
        return xp.concatenate([shown, *parts]).astype(np.float32)

    def act(self, step_state: StepState, action: Array) -> tuple[StepState, Decision]:
        """Return the new step state and the message for an action ``(actions,)``."""
        state, now = step_state.state, self._now(step_state)
        xp = namespace(action, now, state.command)
        action = xp.asarray(action, np.float32)
        command = self.command(state.command, action)
        row = self.row(step_state.inputs[SENSOR][-1].data, now, command, action).astype(np.float32)
        past = xp.concatenate([row[None], state.past])[: self._history]
        new = state.replace(command=command, last=action, before=state.last, past=past)
        return step_state.replace(state=new), self._decision(command, step_state)

    def step(self, step_state: StepState) -> tuple[StepState, Decision]:
        policy, state = step_state.params.policy, step_state.state
        if policy is None:
            return self.act(step_state, np.zeros(self._actions, np.float32))
        if not hasattr(policy, "step"):
            return self.act(step_state, policy.get_action(self.observe(step_state)))
        carry, action = policy.step(state.carry, self.observe(step_state))
        return self.act(step_state.replace(state=state.replace(carry=carry)), action)

    def _decision(self, command: Array, step_state: StepState) -> Decision:
        if not self._aims:
            return Decision(command)
        aim = self.aim(step_state)
        return Decision(command, namespace(aim).asarray(aim, np.float32))

    def _now(self, step_state: StepState) -> Array:
        return self.features(step_state.inputs[SENSOR][-1].data, step_state)

    def _params(self, graph_state: GraphState | None) -> AgentParams:
        return (graph_state or GraphState()).params.get(self.name) or self.init_params()


class GoalAgent(PolicyAgent):
    """Sends goals to position-controlled servos; a policy's action is the speed of the goals.

    So the goals are continuous and of limited speed for every policy, and exploration noise averages out.

    Args:
        low: Shape ``(joints,)``: lowest goals [rad].
        high: Shape ``(joints,)``: highest goals [rad].
        features: Returns the present features: (reading, goals, aim) -> ``(features,)``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        low: Sequence[float],
        high: Sequence[float],
        features: Callable[[JointReading, Array, Array], Array],
        history: int,
        aims: int,
        at: Callable[[Array, Scalar], Array] | None = None,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, len(low), history, (3 * len(low),), aims, at, **options)
        self._low, self._high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        self._features = features

    def features(self, reading: JointReading, step_state: StepState) -> Array:
        return self._features(reading, step_state.state.command, self.aim(step_state))

    def command(self, before: Array, action: Array) -> Array:
        return namespace(before, action).clip(before + action / self.rate, self._low, self._high)

    def row(self, reading: JointReading, features: Array, command: Array, action: Array) -> Array:
        return namespace(command, reading.position).concatenate([reading.position, reading.velocity, command])
