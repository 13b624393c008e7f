"""A compiled graph as an environment for PPO: one row of the graph is one step."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState, StepState
from sim2real.runtime.compiled import CompiledGraph
from sim2real.train.protocol import Step


class Task(Protocol):
    """What a pipeline says about training: who acts, from what, for which reward.

    Attributes:
        supervisor: The node that the policy acts for.
        observation_size: Entries of an observation.
        action_low: Shape ``(A,)`` [the command's unit].
        action_high: Shape ``(A,)`` [the command's unit].
    """

    supervisor: str
    observation_size: int
    action_low: np.ndarray
    action_high: np.ndarray

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Draw the parameters of the graph's nodes for one episode."""
        ...

    def observe(self, step_state: StepState) -> jax.Array:
        """Return what the policy sees, shape ``(observation_size,)``."""
        ...

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, Any]:
        """Return the results of the supervisor's step for an action, shape ``(A,)``."""
        ...

    def reward(self, graph_state: GraphState, action: jax.Array) -> jax.Array:
        """Return the reward of the row that has just ended."""
        ...

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the state after a row is one that the task wants, bool."""
        ...


class EnvState(NamedTuple):
    """The environment between two policy steps.

    Attributes:
        graph: The graph, with everything before the supervisor's step of this row done.
        step_state: What the supervisor sees.
        total: Sum of the rewards so far.
        good: Rows of the second half of the episode in which the task was fulfilled.
    """

    graph: GraphState
    step_state: StepState
    total: jax.Array
    good: jax.Array


class GraphEnvironment:
    """A graph over its timelines, each episode on a timeline of its own, with parameters of its own.

    An episode is over where its timeline is, and before that where a composed task in it ends.

    Args:
        graph: The compiled graph; its supervisor must be the task's.
        task: The pipeline's task.

    Raises:
        UsageError: When the supervisor makes several steps in one row of the timelines.
    """

    def __init__(self, graph: CompiledGraph, task: Task) -> None:
        self.graph, self.task = graph, task
        self.observation_size = task.observation_size
        self.action_low, self.action_high = task.action_low, task.action_high
        # The last row's observation would lie behind the end of the tables. As episodes end before it, no row has to
        # ask whether it is inside: physics run unmasked.
        self.length = graph.rows - 1
        # Traced once each, for shapes, rollouts and evaluations alike: of MuJoCo's worlds that takes 5 s every time.
        self.reset, self.step = jax.jit(self._reset), jax.jit(self._step)
        # Worlds of composed tasks say themselves when an episode is over; importing them here would import MuJoCo.
        found: dict[str, Any] = {name: getattr(node, "ends", None) for name, node in graph.nodes.items()}
        self._ending = {name: ends for name, ends in found.items() if ends is not None}

    def _reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode on a random timeline."""
        k_eps, k_params, k_init = jax.random.split(key, 3)
        eps = jax.random.randint(k_eps, (), 0, self.graph.episodes)
        gs = self.graph.init(k_init, params=self.task.params(k_params), eps=eps)
        gs, step_state, _ = self.graph.observe(gs, inside=True)
        state = EnvState(gs, step_state, jnp.float32(0.0), jnp.float32(0.0))
        return state, self.task.observe(step_state)

    def _step(self, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        """Act, run the world, and run up to the next policy step."""
        del key
        valid = state.step_state.seq >= 0
        step_state, output = self.task.act(state.step_state, action)
        gs = self.graph.advance(state.graph, step_state, output, inside=True)
        reward = self.task.reward(gs, action)
        second_half = gs.step > self.length // 2
        good = state.good + jnp.where(second_half & self.task.success(gs), 1.0, 0.0)
        total = state.total + reward
        ended = [ends(gs.state[name]) for name, ends in self._ending.items()]
        terminated = jnp.any(jnp.array([e[0] for e in ended], bool))
        truncated = (gs.step >= self.length) | jnp.any(jnp.array([e[1] for e in ended], bool))
        gs, step_state, _ = self.graph.observe(gs, inside=True)
        metrics = {"return": total, "success": good / (self.length - self.length // 2)}
        new = EnvState(gs, step_state, total, good)
        return Step(new, self.task.observe(step_state), reward, terminated, truncated, valid, metrics)
