"""What an encoder says of an angle."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct

from sim2real.graph.base import Base


@struct.dataclass
class Encoder(Base):
    """An encoder that was zeroed and mounted a little off.

    It reads ``angle + offset + eccentricity * sin(angle + phase)``.

    Attributes:
        offset: What it reads at angle 0 [rad].
        eccentricity: Distance of its centre from the axis, over its radius [rad].
        phase: Direction of that [rad].
    """

    offset: Any = 0.0
    eccentricity: Any = 0.0
    phase: Any = 0.0

    def read(self, angle: Any) -> Any:
        """Return the reading [rad] at an angle [rad]."""
        return angle + self.offset + self.eccentricity * jnp.sin(angle + self.phase)

    def rate(self, angle: Any, velocity: Any) -> Any:
        """Return how fast the reading changes [rad/s]."""
        return velocity * (1.0 + self.eccentricity * jnp.cos(angle + self.phase))

    def angle(self, reading: Any) -> Any:
        """Return the angle [rad] of a reading [rad], by three steps of a contraction: exact to eccentricity^4."""
        angle = reading - self.offset
        for _ in range(3):
            angle = reading - self.offset - self.eccentricity * jnp.sin(angle + self.phase)
        return angle
