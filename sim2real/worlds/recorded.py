"""Nodes that stand for a recorded sender: they do not run, as their outputs are in the log."""

from __future__ import annotations

from typing import Any

import jax
from flax import struct

from sim2real.graph.base import Base, GraphState
from sim2real.graph.node import BaseNode


@struct.dataclass
class CommandDelay(Base):
    """Parameters of a recorded actuator.

    Attributes:
        delay: Delay from a command's time stamp to its effect [s]; None: that of the connection.
    """

    delay: Any = None


class RecordedActuator(BaseNode):
    """The node that sent the recorded commands.

    Args:
        name: Unique in the graph.
        rate: Largest number of commands per second [Hz].
        message: A command; it is the node's default output.
    """

    def __init__(self, name: str, rate: float, message: Any) -> None:
        super().__init__(name, rate)
        self._message = message

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> CommandDelay:
        """Return parameters without a delay."""
        del rng, graph_state
        return CommandDelay()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return the command that the node was made with."""
        del rng, graph_state
        return jax.tree_util.tree_map(lambda leaf: leaf, self._message)


def command_delay(graph_state: GraphState | None, actuator: str = "actuator") -> dict[str, Any]:
    """Return what a world's ``init_delays`` returns: the actuator's delay [s], if its parameters have one."""
    delay = getattr((graph_state or GraphState()).params.get(actuator), "delay", None)
    return {} if delay is None else {actuator: delay}
