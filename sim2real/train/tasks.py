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
