"""Bounds on errors of predictions, and the errors beside the bounds that were given before."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sim2real.artifacts.summary import ArtifactTable

Reach = Literal["ahead", "free run"]
AHEAD: Reach = "ahead"
FREE_RUN: Reach = "free run"
MAX_ERROR_RATIO = 1.25
"""Largest ratio of an error to its bound at which the promise is not broken: one error in twenty may exceed its bound,
and it seldom exceeds it by this."""

PROMISE_BROKEN = "promise broken"
"""The verdict on an identification whose errors on held-out data exceed their bounds."""


@dataclass(frozen=True)
class Growth:
    """How errors grow with the motion of a log: in proportion to a power of one size of the motion.

    Attributes:
        size: The name of the size, such as ``largest step`` of the goal; see ``growth.sizes``.
        power: The exponent of the size.
        usual: Its median over the recordings.
        low, high: Its least and largest values; the bound for a motion below ``low`` is that for ``low``.
        bound: The bound for a usual motion; 0 before it is computed.
    """

    size: str
    power: float
    usual: float
    low: float
    high: float
    bound: float = 0.0

    def factor(self, sizes: Mapping[str, float], stretch: float) -> float:
        """Return the factor of a log's bound over that for a usual motion.

        Args:
            sizes: The sizes of the log's motion; without this size the motion counts as the largest.
            stretch: Factor of a motion that leaves the range of all fitted ones; see ``predicted_logs.stretches``.
        """
        value = max(sizes.get(self.size, self.high), self.low)
        return max((value / self.usual) ** self.power, (min(value, self.high) / self.usual) ** self.power * stretch)


@dataclass(frozen=True)
class Bound:
    """A promise: 95 % of the errors of a position on later logs stay below ``bound``.

    Attributes:
        column: The position among the measured fields, such as ``position[1]``.
        name: Its name for people.
        reach: ``ahead``: windows of a horizon, each from a state of its own; ``free run``: one run.
        seconds: The horizon, or the length of the run [s].
        scope: What the bound is about: ``this recording`` or ``recordings like these``.
        growth: How the bound of a single log follows its motion; None if errors do not depend on the motion.
    """

    column: str
    name: str
    unit: str
    reach: Reach
    seconds: float
    bound: float
    scope: str
    growth: Growth | None = None

    def on(self, sizes: Mapping[str, float], stretch: float) -> tuple[float, float]:
        """Return the bound for a log, and its factor over the bound for a usual motion; see ``Growth.factor``."""
        if self.growth is None or self.growth.size not in sizes:
            return stretch * self.bound, stretch
        factor = self.growth.factor(sizes, stretch)
        return factor * self.growth.bound, factor


@dataclass(frozen=True)
class Promise:
    """An error beside the bound that was given before the prediction.

    Attributes:
        source: The predicted data: a held-out part, the held-out quarter, or a log.
        fresh: Whether the estimates never depended on this data; held-out parts are fitted afterwards.
        seconds: The horizon, or the length of the run [s]; 0 for a part in older files.
        error: Root mean square error; None if it is infinite.
        bound: None if too few parts gave one.
        stretch: Factor of this data in ``bound``, which needs no prediction: more than 1 if the motion is faster or
            reaches further than the fitted one. Where errors grow with the motion, its bound over that for a usual one.
    """

    source: str
    fresh: bool
    column: str
    name: str
    unit: str
    reach: Reach
    seconds: float
    error: float | None
    bound: float | None = None
    stretch: float = 1.0

    @property
    def ratio(self) -> float | None:
        """The error over its bound; None without a bound."""
        return None if self.bound is None else math.inf if self.error is None else self.error / self.bound

    @property
    def broken(self) -> bool:
        """Whether the error exceeds its bound by more than ``MAX_ERROR_RATIO``."""
        return self.ratio is not None and self.ratio > MAX_ERROR_RATIO

    @property
    def kept(self) -> str:
        """Whether the promise is kept, as text; an error above its bound by less is ``within`` the ratio."""
        if self.ratio is None:
            return "none was made"
        return "no" if self.broken else "yes" if self.ratio <= 1.0 else f"within {MAX_ERROR_RATIO:g}"

    @property
    def horizon(self) -> str:
        """How far the prediction reaches, as text."""
        if not self.seconds:
            return self.reach
        return f"{self.seconds:.3g} s ahead" if self.reach == AHEAD else f"free run of {self.seconds:.3g} s"

    def sentence(self) -> str:
        """Return the error and its bound as text."""
        unit, where = f" {self.unit}".rstrip(), self.source
        how = f"up to {self.seconds:.3g} s ahead" if self.reach == AHEAD else f"in a free run of {self.seconds:.3g} s"
        size = "diverges" if self.error is None else f"is off by {self.error:.2g}{unit}"
        ratio = "" if self.ratio is None or self.error is None else f", {self.ratio:.2f} times as much"
        bound = "" if self.bound is None else f"; promised was {self.bound:.2g}{unit}{ratio and f': {ratio[2:]}'}"
        wider = f" ({self.stretch:.2g} times the usual bound, for its motion)" if bound and self.stretch != 1.0 else ""
        return f"{self.name} {size} {how} on {where}{bound}{wider}"


def too_many_broken(rows: Sequence[Promise]) -> bool:
    """Return whether promises about data that no estimate depended on are broken; of twenty alike, one may be.

    Bounds are for 95 % of the errors, so of many some are exceeded although each bound is right.
    """
    counts: dict[tuple[str, Reach], list[bool]] = {}
    for r in rows:
        if r.fresh and r.ratio is not None:
            counts.setdefault((r.column, r.reach), []).append(r.broken)
    return any(sum(those) > len(those) // 20 for those in counts.values())


def promises_table(rows: Sequence[Promise]) -> ArtifactTable:
    """Return a row for each error with a bound, the largest ratio first."""
    cells = []
    for r in sorted(rows, key=lambda row: -(row.ratio or 0.0)):
        if r.ratio is not None:
            error = math.inf if r.error is None else r.error
            cells.append([r.name, r.source, r.horizon, r.bound, error, r.unit, f"{r.ratio:.2f}", r.kept])
    return ArtifactTable(("position", "predicted", "horizon", "promised", "shown", "unit", "ratio", "kept"), cells)
