"""The policy's node on the robot: the agent's observation and message around a bundle's runner, without JAX."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sim2real import pytree
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.policy.upright import Runner
from sim2real.types import Key, PyTree


class PolicyNode(BaseNode):
    """The agent's node on the wall clock; it calls the bundle's runner instead of a policy in JAX.

    The agent makes observations and messages, from numpy arrays; its own ``step`` is not called.

    Args:
        agent: The agent's node, with ``observe(step_state)`` and ``act(step_state, action)``; it is left unconnected.
    """

    jittable = False

    def __init__(self, agent: Any, runner: Runner) -> None:
        super().__init__(agent.name, agent.rate, delay=agent.delay, delay_dist=agent.delay_dist)
        self._agent, self._runner = agent, runner

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the agent's parameters, in numpy."""
        return _in_numpy(self._agent.init_params, rng, graph_state)

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the agent's state, in numpy."""
        return _in_numpy(self._agent.init_state, rng, graph_state)

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the agent's default message, in numpy."""
        return _in_numpy(self._agent.init_output, rng, graph_state)

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        """Begin an episode."""
        del graph_state, timeout
        self._runner.reset()
        return True

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Make a step with the policy's action.

        Raises:
            SafetyStop: An observation or the action is not finite.
        """
        action = self._runner(np.asarray(self._agent.observe(step_state), np.float32))
        return self._agent.act(step_state, action)


def in_numpy(tree: PyTree) -> PyTree:
    """Return a pytree with numpy arrays for leaves: an array of JAX turns every later computation into one of JAX."""
    return pytree.map(np.asarray, tree)


def _in_numpy(make: Callable[[Any, GraphState | None], Any], rng: Any, graph_state: GraphState | None) -> PyTree:
    return in_numpy(make(rng, graph_state))
