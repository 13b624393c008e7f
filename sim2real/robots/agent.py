"""The policy's node: measurements and a short history in, goals of the joints out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.robots.messages import Decision, JointReading

Features = Callable[[JointReading, Any, Any], jax.Array]


@struct.dataclass
class AgentParams(Base):
    """What the agent is given for an episode.

    Attributes:
        policy: A pytree with ``get_action(observation)``; None keeps the goals where they are.
        aim: What the episode is about, ``(k,)`` in the task's units.
        start: Goals at the start, ``(joints,)`` [rad].
    """

    policy: Any = None
    aim: Any = None
    start: Any = None


@struct.dataclass
class AgentState(Base):
    """The goals ``(joints,)`` [rad], and what was seen and told before ``(steps, 3 * joints)``, newest first."""

    goal: Any
    past: Any


class GoalAgent(BaseNode):
    """Moves the goals of position-controlled servos: a policy's action is their speed.

    So goals are continuous whatever the policy does, no faster than ``speed``, and noise of exploration averages out.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        low: Lowest goals ``(joints,)`` [rad].
        high: Highest goals ``(joints,)`` [rad].
        features: What the policy sees of the present: (reading, goals, aim) -> ``(features,)``.
        history: Past steps that it sees.
        aims: Entries of an aim.
        **options: As of ``BaseNode``.
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
        **options: Any,
    ) -> None:
        super().__init__(name, rate, **options)
        self._low, self._high = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
        self._features, self._history, self._aims = features, history, aims

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> AgentParams:
        """Return no policy, and zeros for the rest."""
        del rng, graph_state
        return AgentParams(aim=jnp.zeros(self._aims), start=jnp.zeros_like(self._low))

    def init_state(self, rng: Any = None, graph_state: GraphState | None = None) -> AgentState:
        """Return goals where the episode starts, and an empty history."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        start = jnp.asarray(params.start, jnp.float32)
        return AgentState(goal=start, past=jnp.zeros((self._history, 3 * start.size)))

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Decision:
        """Return the goals at the start."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return Decision(jnp.asarray(params.start, jnp.float32), jnp.asarray(params.aim, jnp.float32))

    def observe(self, step_state: StepState) -> jax.Array:
        """Return what the policy sees: the features, then the history, newest first."""
        reading, state = step_state.inputs["sensor"][-1].data, step_state.state
        now = self._features(reading, state.goal, step_state.params.aim)
        return jnp.concatenate([now, state.past.ravel()]).astype(jnp.float32)

    def act(self, step_state: StepState, action: Any) -> tuple[StepState, Decision]:
        """Return the step's results for an action: speeds of the goals ``(joints,)`` [rad/s]."""
        reading, state = step_state.inputs["sensor"][-1].data, step_state.state
        goal = jnp.clip(state.goal + jnp.asarray(action, jnp.float32) / self.rate, self._low, self._high)
        row = jnp.concatenate([reading.position, reading.velocity, goal]).astype(jnp.float32)
        new = AgentState(goal=goal, past=jnp.concatenate([row[None], state.past])[: self._history])
        decision = Decision(goal, jnp.asarray(step_state.params.aim, jnp.float32))
        return step_state.replace(state=new), decision  # pyright: ignore[reportAttributeAccessIssue]

    def step(self, step_state: StepState) -> tuple[StepState, Decision]:
        """Ask the policy."""
        policy = step_state.params.policy
        action = jnp.zeros_like(self._low) if policy is None else policy.get_action(self.observe(step_state))
        return self.act(step_state, action)
