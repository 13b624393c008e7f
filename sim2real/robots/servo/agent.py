"""The policy's node: reads measurements, keeps a short history, and sends goals of joints, or actions as they are.

``observe`` and ``act`` compute with the type of their arguments: JAX in a compiled graph, numpy on the wall
clock, where a call of JAX for each small array would take longer than the policy.
"""

from collections.abc import Callable, Sequence
from typing import Unpack

import numpy as np

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.robots.loop import SENSOR
from sim2real.robots.messages import Decision, JointReading
from sim2real.types import Array, Key, PyTree

Features = Callable[[JointReading, Array, Array], Array]
"""Returns the present part of the observation: (reading, goals, aim) -> ``(features,)``."""


@pytree.dataclass
class AgentParams(Base):
    """The agent's parameters for an episode.

    Attributes:
        policy: A pytree with ``get_action(observation)``, or, if it has memory, with ``initial_carry()`` and
            ``step(carry, observation)``; None: the goals stay constant.
        aim: Shape ``(k,)``: the task's aim in this episode, e.g. a target [the task's units].
        start: Shape ``(joints,)``: goals at the start [rad].
    """

    policy: PyTree = None
    aim: Array | None = None
    start: Array | None = None


@pytree.dataclass
class AgentState(Base):
    """The agent's state.

    Attributes:
        goal: Shape ``(joints,)``: the goals [rad].
        past: Shape ``(history, 3 * joints)``: positions [rad], velocities [rad/s] and goals [rad] of the last steps,
            newest first.
        carry: State of a policy with memory.
    """

    goal: Array
    past: PyTree
    carry: PyTree = ()


def first_carry(policy: PyTree) -> PyTree:
    """Return a policy's state before the first step; ``()`` without memory."""
    return policy.initial_carry() if hasattr(policy, "initial_carry") else ()


def decide(policy: PyTree, carry: PyTree, observation: Array) -> tuple[PyTree, Array]:
    """Return a policy's next state, and its action.

    Args:
        observation: Shape ``(O,)``.
    """
    return policy.step(carry, observation) if hasattr(policy, "step") else (carry, policy.get_action(observation))


class GoalAgent(BaseNode):
    """Sends goals to position-controlled servos; a policy's action is the speed of the goals.

    So the goals are continuous and of limited speed for every policy, and exploration noise averages out.

    Args:
        rate: Steps per second [Hz].
        low: Shape ``(joints,)``: lowest goals [rad].
        high: Shape ``(joints,)``: highest goals [rad].
        features: Present part of the observation: (reading, goals, aim) -> ``(features,)``.
        **options: Options of ``BaseNode``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        low: Sequence[float],
        high: Sequence[float],
        features: Features,
        history: int,
        aims: int,
        sensor: str = SENSOR,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._low, self._high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        self._features, self._history, self._aims, self._sensor = features, history, aims, sensor

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        """Return parameters without a policy, and zeros for aim and start."""
        del rng, graph_state
        return AgentParams(aim=np.zeros(self._aims, np.float32), start=np.zeros_like(self._low))

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentState:
        """Return the goals at the start, and a history of zeros."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        start = namespace(params.start).asarray(params.start, np.float32)
        past = np.zeros((self._history, 3 * start.size), np.float32)
        return AgentState(goal=start, past=past, carry=first_carry(params.policy))

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> Decision:
        """Return a message with the goals at the start."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return Decision(*(namespace(x).asarray(x, np.float32) for x in (params.start, params.aim)))

    def observe(self, step_state: StepState) -> Array:
        """Return the policy's observation: the features, then the history, newest first."""
        reading, state = step_state.inputs[self._sensor][-1].data, step_state.state
        now = self._features(reading, state.goal, step_state.params.aim)
        return namespace(now, state.past).concatenate([now, state.past.ravel()]).astype(np.float32)

    def act(self, step_state: StepState, action: Array) -> tuple[StepState, Decision]:
        """Return the new step state and the message for an action ``(joints,)``: speeds of the goals [rad/s]."""
        reading, state = step_state.inputs[self._sensor][-1].data, step_state.state
        xp = namespace(action, state.goal, reading.position)
        goal = xp.clip(state.goal + xp.asarray(action, np.float32) / self.rate, self._low, self._high)
        row = xp.concatenate([reading.position, reading.velocity, goal]).astype(np.float32)
        new = state.replace(goal=goal, past=xp.concatenate([row[None], state.past])[: self._history])
        decision = Decision(goal, xp.asarray(step_state.params.aim, np.float32))
        return step_state.replace(state=new), decision

    def step(self, step_state: StepState) -> tuple[StepState, Decision]:
        """Make a step with the policy's action."""
        policy, state = step_state.params.policy, step_state.state
        if policy is None:
            return self.act(step_state, np.zeros_like(self._low))
        carry, action = decide(policy, state.carry, self.observe(step_state))
        return self.act(step_state.replace(state=state.replace(carry=carry)), action)


@pytree.dataclass
class Past(Base):
    """The last steps, newest first.

    Attributes:
        observations: Shape ``(history, features)``.
        actions: Shape ``(history, actions)``.
        carry: State of a policy with memory.
    """

    observations: Array
    actions: Array
    carry: PyTree = ()


class DirectAgent(BaseNode):
    """Sends a policy's actions unchanged, e.g. voltages.

    Its observation has features of the newest measurement, and the features and actions of the last steps.

    Args:
        rate: Steps per second [Hz].
        features: The policy's features of a measurement: message of the sensor -> ``(features,)``.
        **options: Options of ``BaseNode``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        features: Callable[[PyTree], Array],
        sizes: tuple[int, int],
        history: int,
        message: Callable[[PyTree], PyTree],
        sensor: str = SENSOR,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._features, self._sizes, self._history = features, sizes, history
        self._message, self._sensor = message, sensor

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        """Return no policy."""
        del rng, graph_state
        return AgentParams()

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> Past:
        """Return an empty history."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return Past(
            *(np.zeros((self._history, size), np.float32) for size in self._sizes), carry=first_carry(params.policy)
        )

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a message with zeros."""
        del rng, graph_state
        return self._message(np.zeros(self._sizes[1], np.float32))

    def observe(self, step_state: StepState) -> Array:
        """Return the policy's observation: the features, then the history, newest first."""
        past, now = step_state.state, self._now(step_state)
        xp = namespace(now, past.observations)
        return xp.concatenate([now, past.observations.ravel(), past.actions.ravel()])

    def act(self, step_state: StepState, action: Array) -> tuple[StepState, PyTree]:
        """Return the new step state and the message for an action ``(actions,)``."""
        past, now = step_state.state, self._now(step_state)
        xp = namespace(action, now, past.observations)
        new = past.replace(
            observations=xp.concatenate([now[None], past.observations[:-1]]),
            actions=xp.concatenate([xp.asarray(action, np.float32)[None], past.actions[:-1]]),
        )
        return step_state.replace(state=new), self._message(action)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Make a step with the policy's action."""
        policy, past = step_state.params.policy, step_state.state
        if policy is None:
            return self.act(step_state, np.zeros(self._sizes[1], np.float32))
        carry, action = decide(policy, past.carry, self.observe(step_state))
        return self.act(step_state.replace(state=past.replace(carry=carry)), action)

    def _now(self, step_state: StepState) -> Array:
        return self._features(step_state.inputs[self._sensor][-1].data)
