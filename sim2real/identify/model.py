"""What a pipeline says about identification: which fields were measured, and a graph that predicts them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import ParameterTable


@dataclass(frozen=True)
class Channel:
    """A measured joint: fields of the sensor's output, and how far a measurement may be off.

    Attributes:
        position: Field of the angle or position.
        velocity: Field of its rate; None where the log has none.
        position_sigma: Deviation of a measured position [position's unit].
        velocity_sigma: Deviation of a measured velocity; without one, of a velocity estimated from a few positions.
        index: Entry of the fields, where they are vectors.
        label: Name for tables; default: the position's field.
        goal: Field of a command that holds the joint's goal, in the position's unit and under the same index; None
            where commands are no positions.
    """

    position: str
    velocity: str | None
    position_sigma: float
    velocity_sigma: float
    index: int | None = None
    label: str = ""
    goal: str | None = None

    @property
    def name(self) -> str:
        """The channel's name in tables."""
        return self.label or (self.position if self.index is None else f"{self.position}[{self.index}]")

    @property
    def fields(self) -> tuple[tuple[str, float], ...]:
        """Field and deviation of position and, if measured, of velocity, in the order of residuals."""
        both = ((self.position, self.position_sigma), (self.velocity, self.velocity_sigma))
        return tuple((f, s) for f, s in both if f is not None)

    def of(self, rows: Any) -> Any:
        """Return the channel's entry of a field, ``(..., F)`` -> ``(...)``."""
        return rows if self.index is None else rows[..., self.index]


class IdentifiableModel(Protocol):
    """What a pipeline provides for identification.

    Attributes:
        parameters: What may be identified.
        sensor: Node whose outputs are predicted.
        given: Nodes whose recorded outputs drive the model: node -> a message with field names as its leaves.
        channels: What is measured; initial states have a position and a velocity for each.
        ahead_s: How much later than recorded the sensor's steps are simulated [s]; ``params`` adds it to the sensor's
            delay, so that nothing shifts. 0 where samples fall on the world's ticks; a sensor that interpolates between
            them needs one tick: with a shorter delay it would otherwise read what is not simulated yet.
    """

    parameters: ParameterTable
    sensor: str
    given: Mapping[str, Any]
    channels: tuple[Channel, ...]
    ahead_s: float

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, given nodes and world, connected with trainable delays up to ``max_delay_s``."""
        ...

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial state ``(2 * channels,)``: positions, then velocities."""
        ...
