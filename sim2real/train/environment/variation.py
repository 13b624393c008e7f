"""In what the episodes of training differ; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import UseAppendAction

from sim2real.errors import UsageError


@dataclass(frozen=True)
class VariationConfig:
    """In what the episodes of training differ from each other."""

    misfit: bool = True
    """Widen the identification's posterior until its draws predict as spread out as the model lies off the log."""
    pauses: bool = True
    """Keep the pauses of the robot's computer; otherwise steps of more than a quarter of the period are left out."""
    noise: float = 1.0
    """Factor on the noise, the rounding and the bias of the sensor that the log shows; 0: exact readings."""
    uniform: float = 0.0
    """Draw dynamics and delays uniformly instead, this share of their value up and down: 0.3 is 30 %; 0: as the
    posterior says."""
    range: Annotated[dict[str, tuple[float, float]], UseAppendAction] = field(default_factory=dict)
    """Draw a parameter uniformly from here, whatever was identified, for instance a payload: NAME LOW HIGH, one flag a
    parameter."""
    push: float = 0.0
    """Largest change of a joint's velocity by a push from outside [rad/s]; all up to it are as likely; 0: no pushes."""
    push_hz: float = 0.5
    """Pushes of each joint in a second, at random times [Hz]."""
    start_position: float = 0.0
    """Episodes start up to so far from where the robot has them start, each joint by itself [rad]."""
    start_velocity: float = 0.0
    """Episodes start up to so much faster or slower than the robot has them start, each joint by itself [rad/s]."""
    curriculum: tuple[float, float] = (1.0, 1.0)
    """Share of all those differences (parameters, delays, noise, pushes, starts) at the first and at the last update;
    in between it grows evenly. Evaluations have the last. 0 1 begins with the model alone."""

    @property
    def grows(self) -> bool:
        """Whether episodes differ by another share as training goes on, or by less than all."""
        return self.curriculum != (1.0, 1.0)

    def __post_init__(self) -> None:
        """Check what can be checked before anything is read."""
        if not 0.0 <= self.noise <= 100.0:
            raise UsageError(f"vary.noise must lie in [0, 100], got {self.noise}")
        if not 0.0 <= self.uniform < 1.0:
            raise UsageError(f"vary.uniform must lie in [0, 1), got {self.uniform}", hint="0.3 is 30 % up and down")
        for name in ("push", "start_position", "start_velocity"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise UsageError(f"vary.{name} must lie in [0, 100], got {getattr(self, name)}")
        if not 0.0 < self.push_hz <= 1000.0:
            raise UsageError(f"vary.push_hz must lie in (0, 1000] Hz, got {self.push_hz}")
        if not (0.0 <= self.curriculum[0] <= 1.0 and 0.0 < self.curriculum[1] <= 1.0):
            given = " ".join(map(str, self.curriculum))
            raise UsageError(
                f"vary.curriculum must be two shares in [0, 1], the second above 0, got {given}",
                hint="--randomise 2 makes the differences themselves larger",
            )
        for name, (low, high) in self.range.items():
            if not low < high:
                raise UsageError(f"vary.range of {name} must be LOW HIGH with LOW < HIGH, got {low} {high}")
