"""One quantity, estimated separately from each of several recordings."""

from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.files import check


@dataclass(frozen=True)
class Quantity:
    """One quantity, estimated from each of R recordings alone, and the mean of these estimates.

    Attributes:
        estimates: Shape ``(R,)``.
        standard_errors: Shape ``(R,)``.
        standard_error: Of the mean.
        between: Deviation between recordings, beyond their standard errors.
        low95: Lower end of the 95 % interval for a further recording.
        agree: Whether the standard errors explain the differences between the estimates.
    """

    name: str
    unit: str
    estimates: np.ndarray
    standard_errors: np.ndarray
    mean: float
    standard_error: float
    between: float
    low95: float
    high95: float
    agree: bool

    def __post_init__(self) -> None:
        check(self.estimates.shape == self.standard_errors.shape, f"{self.name}: estimates without errors")
