"""The noise of a sensor: how its readings scatter around the motion."""

import math
import re
from dataclasses import dataclass

from sim2real.artifacts.files import check

_COLUMN = re.compile(r"(.+?)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Noise:
    """The differences between one measured quantity and the identified model.

    Attributes:
        column: A field of the sensor's message, with an index ``[i]`` if the field is a vector.
        deviation: Standard deviation of the part that changes from sample to sample; includes jitter of sampling times.
        quantum: Step between neighbouring readings; 0 if readings have no step.
        bias: Standard deviation of the part that is constant over a segment.
    """

    column: str
    unit: str
    deviation: float
    quantum: float
    bias: float

    def __post_init__(self) -> None:
        """Check the numbers, which can come from a file."""
        sizes = (self.deviation, self.quantum, self.bias)
        check(all(math.isfinite(s) and s >= 0.0 for s in sizes), f"{self.column}: noise of {sizes}")

    @property
    def place(self) -> tuple[str, int | None]:
        """The field of the message, and the index in it; None if the field is a number."""
        name, index = _COLUMN.fullmatch(self.column).groups()  # type: ignore[union-attr]  # .+? matches any name
        return name, None if index is None else int(index)
