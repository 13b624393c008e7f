"""How a joint is mounted on its motor: between an encoder's angle and the joint's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Joint:
    """A joint, and what is between it and the encoder of its motor.

    Attributes:
        name: Its name.
        zero_rad: What the encoder reads where the joint's angle is 0 [rad].
        direction: 1 where both turn the same way, -1 where they turn against each other.
        gear: Turns of the encoder for one of the joint.
    """

    name: str
    zero_rad: float = 0.0
    direction: int = 1
    gear: float = 1.0

    def __post_init__(self) -> None:
        """Check that angles can be converted both ways."""
        if self.direction not in (1, -1):
            raise UsageError(f"joint {self.name!r}: direction = {self.direction!r} is neither 1 nor -1")
        if not (math.isfinite(self.gear) and self.gear > 0):
            raise UsageError(
                f"joint {self.name!r}: gear = {self.gear!r} is not a number above 0",
                hint="direction = -1 says that encoder and joint turn against each other",
            )
        if not math.isfinite(self.zero_rad):
            raise UsageError(f"joint {self.name!r}: zero_rad = {self.zero_rad!r} is not a finite angle")

    def angle(self, encoder_rad: Any) -> Any:
        """Return the joint's angle [rad] for an encoder's, of any shape."""
        return self.direction * (encoder_rad - self.zero_rad) / self.gear

    def encoder(self, angle_rad: Any) -> Any:
        """Return what the encoder reads [rad] at an angle of the joint, of any shape."""
        return self.zero_rad + self.direction * self.gear * angle_rad

    def speed(self, encoder_rad_s: Any) -> Any:
        """Return the joint's speed [rad/s] for the encoder's, of any shape."""
        return self.direction * encoder_rad_s / self.gear
