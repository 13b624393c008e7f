"""Nodes of a recording that are not run: what they sent is in the log."""

from __future__ import annotations

from typing import Any

import jax
from flax import struct

from sim2real.graph.base import Base, GraphState
from sim2real.graph.node import BaseNode


@struct.dataclass
class CommandDelay(Base):
    """Delay from a command's time stamp to its effect [s]; None leaves the connection's own."""

    delay: Any = None


class RecordedActuator(BaseNode):
    """What sent the recorded commands.

    Args:
        name: Unique in the graph.
        rate: Commands per second at most [Hz].
        message: A command, as an example.
    """

    def __init__(self, name: str, rate: float, message: Any) -> None:
        super().__init__(name, rate)
        self._message = message

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> CommandDelay:
        """Return no delay of its own."""
        del rng, graph_state
        return CommandDelay()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return the example."""
        del rng, graph_state
        return jax.tree_util.tree_map(lambda leaf: leaf, self._message)


def command_delay(graph_state: GraphState | None, actuator: str = "actuator") -> dict[str, Any]:
    """Return the delays of a world's inputs: that of the actuator, where its parameters set one."""
    delay = getattr((graph_state or GraphState()).params.get(actuator), "delay", None)
    return {} if delay is None else {actuator: delay}
