"""How well a graph kept its times."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
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
        overruns: Steps that could not start when they were due and had what they wait for, as the step before had not
            ended.
        age_s: By input: how long before a step's start the newest message that it used was sent. Where this grows, a
            policy acts on old data, whoever was slow. Inputs are missing of which no step has used a message yet, and
            those with a trainable delay on the simulated clock, where the step itself picks what has arrived.
    """

    steps: int
    period_s: Quantiles
    lateness_s: Quantiles
    overruns: int
    age_s: Mapping[str, Quantiles]


class StepLog:
    """Collects one node's times: 16 bytes a step, and 8 for each input.

    Args:
        inputs: Names of the inputs whose messages are looked at.
    """

    def __init__(self, inputs: Iterable[str] = ()) -> None:
        self._woken = array("q")
        self._late = array("q")
        self._ages = {name: array("q") for name in inputs}
        self._sent: dict[str, int] = {}
        self._overruns = 0

    def read(self, name: str, begin: int, sent: int | None) -> None:
        """Take in what a step that starts at ``begin`` finds at an input: when its newest message was sent [ticks].

        None when none has come since the step before: it then goes on with the one that it had.
        """
        if sent is not None:
            self._sent[name] = sent
        if name in self._sent:
            self._ages[name].append(begin - self._sent[name])

    def add(self, begin: int, woken: int, overrun: bool) -> None:
        """Take in one finished step; times in ticks [us]."""
        self._woken.append(woken)
        self._late.append(woken - begin)
        self._overruns += overrun

    def summary(self) -> NodeStatistics:
        """Return the statistics so far."""
        count = len(self._late)  # read once: the node's thread may be adding
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
