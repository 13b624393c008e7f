"""Nodes that stand for recorded senders, and an encoder: senders do not run, as the log has their outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.later import jax, jnp
from sim2real.types import PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.graph.base import Value


@pytree.dataclass
class Encoder(Base):
    """An encoder with a zero offset and an eccentric mount.

    It reads ``angle + offset + eccentricity * sin(angle + phase)``.

    Attributes:
        offset: Zero offset [rad].
        eccentricity: Amplitude of the mount's error [rad]: distance of the disc's centre from the axis, divided by the
            disc's radius.
        phase: Direction of the displacement [rad].
    """

    offset: Value = 0.0
    eccentricity: Value = 0.0
    phase: Value = 0.0

    def read(self, angle: Value) -> Value:
        """Return the reading [rad] at an angle [rad]."""
        return angle + self.offset + self.eccentricity * jnp.sin(angle + self.phase)

    def rate(self, angle: Value, velocity: Value) -> Value:
        """Return the rate of change of the reading [rad/s] at an angle [rad] and a velocity [rad/s]."""
        return velocity * (1.0 + self.eccentricity * jnp.cos(angle + self.phase))

    def angle(self, reading: Value) -> Value:
        """Return the angle [rad] for a reading [rad]: three fixed-point iterations, error of order eccentricity^4."""
        angle = reading - self.offset
        for _ in range(3):
            angle = reading - self.offset - self.eccentricity * jnp.sin(angle + self.phase)
        return angle


@pytree.dataclass
class DelayParams(Base):
    """Parameters of a sensor or an actuator, simulated or recorded.

    Attributes:
        delay: Delay of its connection with the world [s]; None: the connection's own delay.
        noise: Factor on standard deviation and bias of a sensor's noise; None: 1.
    """

    delay: Scalar | None = None
    noise: Scalar | None = None


def delay_of(node: str, input_name: str, graph_state: GraphState | None) -> dict[str, PyTree]:
    """Return the result of ``init_delays``: input name -> the delay in a node's parameters [s], if they have one."""
    delay = getattr((graph_state or GraphState()).params.get(node), "delay", None)
    return {} if delay is None else {input_name: delay}


class RecordedActuator(BaseNode):
    """The node that sent the recorded commands.

    Args:
        rate: Largest number of commands per second [Hz].
        message: A command, which is the node's default output.
    """

    def __init__(self, name: str, rate: float, message: PyTree) -> None:
        super().__init__(name, rate)
        self._message = message

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return parameters without a delay."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the command that the constructor got."""
        del rng, graph_state
        return pytree.map(lambda leaf: leaf, self._message)


class RecordedSensor(BaseNode):
    """A simulated sensor for identification: outputs the world's joint position through the encoder model.

    Args:
        rate: Samples per second [Hz].
        encoder: The encoder, whose parameters may be identified; None: positions are exact.
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
        """Read the world's newest position."""
        position = step_state.inputs["world"][-1].data.position
        return step_state, self._message(step_state.params.read(position) if self._encoder else position)
