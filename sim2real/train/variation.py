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

    def __post_init__(self) -> None:
        """Check what can be checked before anything is read."""
        if not 0.0 <= self.noise <= 100.0:
            raise UsageError(f"vary.noise must lie in [0, 100], got {self.noise}")
        if not 0.0 <= self.uniform < 1.0:
            raise UsageError(f"vary.uniform must lie in [0, 1), got {self.uniform}", hint="0.3 is 30 % up and down")
        for name, (low, high) in self.range.items():
            if not low < high:
                raise UsageError(f"vary.range of {name} must be LOW HIGH with LOW < HIGH, got {low} {high}")
