"""Nodes in the place of a recorded sender: they do not run, as their outputs are in the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.later import jax, jnp
from sim2real.types import PyTree
from sim2real.worlds.encoder import Encoder

if TYPE_CHECKING:
    from sim2real.graph.base import Value


@pytree.dataclass
class CommandDelay(Base):
    """Parameters of a recorded actuator.

    Attributes:
        delay: Delay from a command's time stamp to its effect [s]; None: that of the connection.
    """

    delay: Value | None = None


class RecordedActuator(BaseNode):
    """The node that sent the recorded commands.

    Args:
        rate: Largest number of commands per second [Hz].
        message: A command; it is the node's default output.
    """

    def __init__(self, name: str, rate: float, message: PyTree) -> None:
        super().__init__(name, rate)
        self._message = message

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> CommandDelay:
        """Return parameters without a delay."""
        del rng, graph_state
        return CommandDelay()

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the command that the node was made with."""
        del rng, graph_state
        return pytree.map(lambda leaf: leaf, self._message)


class RecordedSensor(BaseNode):
    """The node that measured one joint: shows the world's position, as an encoder reads it.

    Args:
        rate: Samples per second [Hz].
        encoder: The encoder; its parameters may be identified. None: positions are shown as they are.
    """

    def __init__(
        self, name: str, rate: float, message: Callable[[jax.Array], Any], encoder: Encoder | None = None
    ) -> None:
        super().__init__(name, rate)
        self._message, self._encoder = message, encoder

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the encoder."""
        return self._encoder or super().init_params(rng, graph_state)

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the message of a position of 0."""
        del rng, graph_state
        return self._message(jnp.float32(0.0))

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Read."""
        position = step_state.inputs["world"][-1].data.position
        return step_state, self._message(step_state.params.read(position) if self._encoder else position)


def command_delay(graph_state: GraphState | None, actuator: str = "actuator") -> dict[str, Value]:
    """Return what a world's ``init_delays`` returns: the actuator's delay [s], if its parameters have one."""
    delay = getattr((graph_state or GraphState()).params.get(actuator), "delay", None)
    return {} if delay is None else {actuator: delay}
