"""Nodes with float messages, whose rounding differences between runtimes die out."""

import jax
import jax.numpy as jnp
from oracles.hash_nodes import Value

from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.types import PyTree


class Contraction(BaseNode):
    """A node with float messages whose state contracts, so that rounding differences between runtimes die out."""

    def init_state(self, rng: PyTree = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a random number."""
        del graph_state
        return jax.random.normal(rng)

    def init_output(self, rng: PyTree = None, graph_state: GraphState | None = None) -> Value:
        """Return a random number."""
        del graph_state
        return Value(x=jax.random.normal(rng))

    def step(self, step_state: StepState) -> tuple[StepState, Value]:
        """Move towards the mean of the inputs, plus a term that differs from step to step."""
        means = [jnp.mean(window.data.x) for _, window in sorted(step_state.inputs.items())]
        target = sum(means) / max(len(means), 1)
        state = 0.5 * step_state.state + 0.4 * target + jnp.sin(1.3 * step_state.seq)
        return step_state.replace(state=state), Value(x=jnp.tanh(state))


class ContractingWorld(Contraction, BaseWorld):
    """A contraction on a world's grid."""


def contracting_node(name: str, rate: float, world: bool, **options: PyTree) -> BaseNode:
    """Return a node with float messages.

    Args:
        rate: Steps per second [Hz].
        **options: Options of ``BaseNode``; not used by a world.
    """
    return ContractingWorld(name, rate) if world else Contraction(name, rate, **options)
