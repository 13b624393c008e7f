"""What identification says about a link: how long messages take, how much that varies, and how many are lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Ranged:
    """A number with its 95 % interval; None where the log says nothing about it."""

    value: float | None
    low95: float | None
    high95: float | None


@dataclass(frozen=True)
class Link:
    """A link, as the motion shows it.

    Attributes:
        name: The delay's parameter.
        parts: What mean and 95th percentile are the sum of: a log of motion tells only their sum. The link's own name
            alone where it is told apart.
        mean: The mean of the delay, of all parts together, in the middle of a recording [s].
        deviation: The standard deviation of this link's delay alone [s].
        p95: What 95 % of the messages do not exceed, of all parts together [s].
        lost: Share of the messages that were lost: their reader saw the message before once more.
        burst: How many messages in a row are lost, on average; None where none was.
        drift: How much faster the clock of the stamps runs than that of the commands [s/s].
        delays: Shape ``(K,)``: delays, of all parts together [s].
        share: Shape ``(K,)``: share of the messages that have each of them.
        jitter: The standard deviation of the commands' delay [s]; as of its mean, a log of motion tells only that of
            all links between command and motion together.
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

    @property
    def told_apart(self) -> bool:
        """Whether the mean is this link's alone."""
        return len(self.parts) == 1

    def rows(self) -> list[tuple[str, Ranged, float, str]]:
        """Return what is known of it: what it is, the number, the factor to the unit that people read, and that unit.

        Of a sum, its parts are named.
        """
        whole, own = " + ".join(self.parts), self.name
        shown = [
            (f"{whole}, mean", self.mean, 1e3, "ms"),
            (f"{whole}, 95 % of the messages", self.p95, 1e3, "ms"),
            (f"{own}, deviation", self.deviation, 1e3, "ms"),
            (f"{' + '.join(self.parts[1:]) or 'commands'}, deviation", self.jitter, 1e3, "ms"),
            (f"{own}, lost", self.lost, 100.0, "%"),
            (f"{own}, lost in a row", self.burst, 1.0, ""),
            (f"{own}, drift of the clock", self.drift, 1e6, "us/s"),
        ]
        return [row for row in shown if row[1].value is not None]
