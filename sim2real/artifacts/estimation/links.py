"""The delay of a link: its distribution, and the share of lost messages."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.summary import ArtifactTable, Interval

_HEADERS = ("link", "estimate", "95 % interval", "unit")


@dataclass(frozen=True)
class Ranged:
    """A number with its 95 % interval; None if the log does not determine it."""

    value: float | None
    low95: float | None
    high95: float | None


@dataclass(frozen=True)
class Link:
    """The delay of a link, estimated from the motion.

    Attributes:
        name: The delay's parameter.
        parts: Delays whose sum has this mean and 95th percentile, as a log of motion determines only their sum; the
            link's name alone if the log determines its delay alone.
        mean: Mean of the sum in the middle of a recording [s].
        deviation: Standard deviation of this link's delay alone [s].
        p95: 95th percentile of the sum [s].
        lost: Share of lost messages: their reader uses the previous message again.
        burst: Mean number of lost messages in a row; None without losses.
        drift: Rate of the stamps' clock relative to the commands' clock, minus 1 [s/s].
        delays: Shape ``(K,)``: values of the sum [s].
        share: Shape ``(K,)``: share of the messages with each of these values.
        jitter: Standard deviation of the commands' delay, over all links between command and motion together [s].
    """

    name: str
    parts: tuple[str, ...]
    mean: Ranged
    deviation: Ranged
    p95: Ranged
    lost: Ranged
    burst: Ranged
    drift: Ranged
    delays: np.ndarray
    share: np.ndarray
    jitter: Ranged = Ranged(None, None, None)

    def rows(self) -> ArtifactTable:
        """Return a row for each number that the log determines."""
        total, name = " + ".join(self.parts), self.name
        numbers = [
            (f"{total}, mean", self.mean, 1e3, "ms"),
            (f"{total}, 95 % of the messages", self.p95, 1e3, "ms"),
            (f"{name}, deviation", self.deviation, 1e3, "ms"),
            (f"{' + '.join(self.parts[1:]) or 'commands'}, deviation", self.jitter, 1e3, "ms"),
            (f"{name}, lost", self.lost, 100.0, "%"),
            (f"{name}, lost in a row", self.burst, 1.0, ""),
            (f"{name}, drift of the clock", self.drift, 1e6, "us/s"),
        ]
        rows = [
            [label, factor * r.value, Interval(_scaled(r.low95, factor), _scaled(r.high95, factor)), unit]
            for label, r, factor, unit in numbers
            if r.value is not None
        ]
        return ArtifactTable(_HEADERS, rows)


def links_table(links: Sequence[Link]) -> ArtifactTable:
    """Return the rows of several links as one table."""
    return ArtifactTable(_HEADERS, [row for link in links for row in link.rows().rows])


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value
