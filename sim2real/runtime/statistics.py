"""Timing statistics of a running graph."""

from array import array
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Quantiles(NamedTuple):
    """Median, 0.99 quantile and maximum of a time [s]; NaN without samples."""

    p50: float
    p99: float
    max: float


class NodeStatistics(NamedTuple):
    """Timing statistics of one node.

    Attributes:
        period_s: Time from one step's wake-up to the next one's.
        lateness_s: Time from a step's start by the timing rules to its wake-up.
        overruns: Number of steps that started late only because the previous step had not ended.
        age_s: Input -> time from the sending of its newest message to a step's start: the age of the data that a policy
            acts on. Inputs without a message are left out; on the simulated clock also inputs with a trainable delay,
            whose message the step itself picks.
    """

    steps: int
    period_s: Quantiles
    lateness_s: Quantiles
    overruns: int
    age_s: Mapping[str, Quantiles]


class StepLog:
    """Collects the times of one node's steps: 16 bytes per step, and 8 more per input."""

    def __init__(self, inputs: Iterable[str] = ()) -> None:
        self._woken = array("q")
        self._late = array("q")
        self._ages = {name: array("q") for name in inputs}
        self._sent: dict[str, int] = {}
        self._overruns = 0

    def read(self, name: str, begin: int, sent: int | None) -> None:
        """Add the age of the newest message of an input.

        Args:
            begin: The step's start [ticks].
            sent: Time at which the newest message was sent [ticks]; None: the step uses the previous message again.
        """
        if sent is not None:
            self._sent[name] = sent
        if name in self._sent:
            self._ages[name].append(begin - self._sent[name])

    def add(self, begin: int, woken: int, overrun: bool) -> None:
        """Add a finished step.

        Args:
            begin: Its start by the timing rules [ticks].
            woken: When it was woken [ticks].
            overrun: Whether it started late because the previous step had not ended.
        """
        self._woken.append(woken)
        self._late.append(woken - begin)
        self._overruns += overrun

    def summary(self) -> NodeStatistics:
        """Return the statistics so far."""
        count = len(self._late)  # copy first: the node's thread may append meanwhile
        return NodeStatistics(
            steps=count,
            period_s=quantiles(np.diff(self._woken[:count])),
            lateness_s=quantiles(self._late[:count]),
            overruns=self._overruns,
            age_s={name: quantiles(ages[:]) for name, ages in self._ages.items() if ages},
        )


def quantiles(ticks: Sequence[int] | np.ndarray) -> Quantiles:
    """Return the quantiles [s] of times [ticks]."""
    seconds = np.asarray(ticks, np.float64) / 1e6
    if not seconds.size:
        return Quantiles(float("nan"), float("nan"), float("nan"))
    return Quantiles(*(float(q) for q in np.quantile(seconds, [0.5, 0.99, 1.0])))
