"""The sum of all delays, which a log determines even if it does not separate the delays."""

from dataclasses import dataclass

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.uncertainty.uncertainty import AT_BOUND, Uncertainty, sum_of, time_shift

SURE_S = 0.005
"""A round trip with a larger standard error is not identified [s]."""


@dataclass(frozen=True)
class RoundTrip:
    """Time from a command to the first measurement of its effect; times in [s].

    Attributes:
        apart: Whether the log separates the parts.
        estimate: The sum.
        low: Lower end of the 95 % interval.
        lower: Sum of the lower bounds and of the fixed delays.
    """

    parts: tuple[str, ...]
    held: tuple[str, ...]
    apart: bool
    estimate: float
    standard_error: float
    low: float
    high: float
    lower: float
    upper: float

    @property
    def at_bound(self) -> str:
        """``lower`` or ``upper`` if the sum lies at a bound, else ""."""
        near = AT_BOUND * (self.upper - self.lower)
        return "lower" if self.estimate - self.lower < near else "upper" if self.upper - self.estimate < near else ""

    @property
    def verdict(self) -> str:
        """``accepted``, ``not identifiable`` or ``at a bound``."""
        if self.standard_error >= SURE_S:
            return "not identifiable"
        return "at a bound" if self.at_bound else "accepted"

    def __str__(self) -> str:
        """Return the sum with its interval in ms."""
        return f"{1e3 * self.estimate:.1f} ms [{1e3 * self.low:.1f}, {1e3 * self.high:.1f}]"


def round_trip(table: ParameterTable, x: np.ndarray, spread: Uncertainty) -> RoundTrip | None:
    """Return the sum of all delays; None if no delay is identified.

    Args:
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
    """
    # Sum free and fixed delays, and their bounds.
    free = [i for i, c in enumerate(table.columns) if c.parameter.kind == "delay"]
    if not free:
        return None
    held = [p for p in table if p.kind == "delay" and not p.free]
    fixed_s = sum(p.nominal for p in held)
    bounds = [(table.columns[i].parameter.low, table.columns[i].parameter.high) for i in free]
    lower, upper = (fixed_s + sum(b[side] for b in bounds) for side in (0, 1))
    total, error = float(table.unscale(x)[free].sum()) + fixed_s, sum_of(spread, free)
    return RoundTrip(
        parts=tuple(table.names[i] for i in free),
        held=tuple(p.name for p in held),
        apart=not time_shift(table).any(),
        estimate=total,
        standard_error=error,
        low=max(lower, total - 1.96 * error),
        high=min(upper, total + 1.96 * error),
        lower=lower,
        upper=upper,
    )
