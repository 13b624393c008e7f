"""What a log shows of a sensor: how its readings scatter around the motion."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sim2real.artifacts.files import check

_COLUMN = re.compile(r"(.+?)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Noise:
    """How one measured quantity lies off the identified model.

    Attributes:
        column: Its name: a field of the sensor's message, with an index ``[i]`` where the field is a vector.
        unit: Unit of all numbers.
        deviation: Standard deviation of what changes from sample to sample; jitter of the sampling times is part of it.
        quantum: Step between neighbouring readings; 0: none was found.
        bias: Standard deviation of what stays the same over a segment.
    """

    column: str
    unit: str
    deviation: float
    quantum: float
    bias: float

    def __post_init__(self) -> None:
        """Check that these are sizes: they may come from a file."""
        sizes = (self.deviation, self.quantum, self.bias)
        check(all(math.isfinite(s) and s >= 0.0 for s in sizes), f"{self.column}: noise of {sizes}")

    @property
    def place(self) -> tuple[str, int | None]:
        """The field of the message, and the index in it; None: the field is a number."""
        name, index = _COLUMN.fullmatch(self.column).groups()  # type: ignore[union-attr]  # .+? takes whatever there is
        return name, None if index is None else int(index)
