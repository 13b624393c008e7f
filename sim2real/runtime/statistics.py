"""How well a graph kept its times."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Quantiles(NamedTuple):
    """Of a time [s]: median, 99 % and the largest; NaN where there is nothing."""

    p50: float
    p99: float
    max: float


class NodeStatistics(NamedTuple):
    """How well one node kept its times.

    Attributes:
        steps: Finished steps.
        period_s: From one step's awakening to the next.
        lateness_s: From a step's start by the rules to its awakening.
        overruns: Steps that ended after the next one was due.
    """

    steps: int
    period_s: Quantiles
    lateness_s: Quantiles
    overruns: int


class StepLog:
    """Collects one node's times: 16 bytes a step."""

    def __init__(self) -> None:
        self._woken = array("q")
        self._late = array("q")
        self._overruns = 0

    def add(self, begin: int, woken: int, end: int, next_due: int) -> None:
        """Take in one finished step; times in ticks [us]."""
        self._woken.append(woken)
        self._late.append(woken - begin)
        self._overruns += end > next_due

    def summary(self) -> NodeStatistics:
        """Return the statistics so far."""
        count = len(self._late)  # read once: the node's thread may be adding
        return NodeStatistics(
            steps=count,
            period_s=_quantiles(np.diff(self._woken[:count])),
            lateness_s=_quantiles(self._late[:count]),
            overruns=self._overruns,
        )


def _quantiles(ticks: Sequence[int] | np.ndarray) -> Quantiles:
    seconds = np.asarray(ticks, np.float64) / 1e6
    if not seconds.size:
        return Quantiles(float("nan"), float("nan"), float("nan"))
    return Quantiles(*(float(q) for q in np.quantile(seconds, [0.5, 0.99, 1.0])))
