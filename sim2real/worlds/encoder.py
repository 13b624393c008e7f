"""A model of an angle encoder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real import pytree
from sim2real.graph.base import Base
from sim2real.later import jnp

if TYPE_CHECKING:
    from sim2real.graph.base import Value


@pytree.dataclass
class Encoder(Base):
    """An encoder with a zero offset and an eccentric mount.

    It reads ``angle + offset + eccentricity * sin(angle + phase)``.

    Attributes:
        offset: Zero offset [rad].
        eccentricity: Amplitude of the error of the mount: distance of the disc's centre from the axis, divided by the
            disc's radius [rad].
        phase: Direction of that displacement [rad].
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
