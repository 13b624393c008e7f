"""What a training task may say besides what ``TrainingTask`` asks of each: protocols of one method."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import jax

from sim2real.graph.base import GraphState


@runtime_checkable
class EndingTask(Protocol):
    """A task that may end an episode before its time, such as a fall."""

    def terminated(self, graph_state: GraphState) -> jax.Array:
        """Return whether the episode ended in the graph's state after a row, bool of shape ``()``."""
        ...


@runtime_checkable
class PrivilegedTask(Protocol):
    """A task that knows what a value function may see besides the policy's observation."""

    def privileged(self, graph_state: GraphState) -> jax.Array:
        """Return what is true in the graph's state, shape ``(P,)``, in any units."""
        ...
