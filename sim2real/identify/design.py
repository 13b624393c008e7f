"""Which motions to record next: those that tell most of what is still uncertain.

A motion's Fisher information is that of its residuals, linearised at what is known. Of many motions those are chosen
whose information, with what is known before, has the largest determinant (D-optimal: Wald, Annals of Mathematical
Statistics 14, 1943). So the volume of what the next recording leaves open is smallest, whatever the units and scales of
the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.posterior import Posterior
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem
from sim2real.identify.uncertainty import Linearised, time_shift

_ROUNDS = 4
_FEWEST = 5
"""Samples of a segment from which on it tells how measurements scatter."""


@dataclass(frozen=True)
class Scatter:
    """How far measurements lie off what the model predicts.

    Attributes:
        white: Variance at rest [deviations of the measurement squared].
        jitter_s2: What is added to it, per square of how fast a quantity changes: the variance of when a measurement
            was made, or a command took effect [s^2].
    """

    white: float = 1.0
    jitter_s2: float = 0.0

    @staticmethod
    def of(found: Identification) -> Scatter:
        """Return what an identification left unexplained, with the correlation of its residuals in time.

        Where its predictions are not there, or say nothing, all of it counts as there at rest.
        """
        inflation = found.residual_inflation or 1.0
        rows = [row for f in found.fields for row in _errors(found, f)]
        if not rows:
            return Scatter((found.misfit or 1.0) ** 2 * inflation)
        errors, rates = np.concatenate(rows, axis=1)
        size = float(np.mean(rates**2)) or 1.0  # both columns of one size
        causes, weight = np.stack([np.ones_like(rates), rates**2 / size], axis=1), np.ones_like(rates)
        parts = np.zeros(2)
        for _ in range(_ROUNDS):  # squares scatter as their own mean: large ones say less
            parts = nnls(causes / weight[:, None], errors**2 / weight)[0]
            weight = np.maximum(causes @ parts, 1.0)
        # A reading is no surer than its own deviation.
        return Scatter(max(float(parts[0]), 1.0) * inflation, float(parts[1]) / size * inflation)


def _errors(found: Identification, field: str) -> list[np.ndarray]:
    """Return for each segment errors and rates of change of a field ``(2, N)``, in deviations of a measurement."""
    samples, parts = found.samples, []
    if field not in found.sigma or f"{field}_identified" not in samples:
        return []
    for segment in np.unique(samples["segment"]):
        own = (samples["segment"] == segment) & np.isfinite(samples[f"{field}_identified"])
        if own.sum() < _FEWEST:
            continue
        predicted, t_s = samples[f"{field}_identified"][own], samples["t"][own]
        rates = np.gradient(predicted, t_s)
        parts.append(np.stack([samples[f"{field}_measured"][own] - predicted, rates])[:, 1:-1] / found.sigma[field])
    return parts


@dataclass(frozen=True)
class Knowledge:
    """What is known of the parameters that recordings can tell, on their scales.

    Attributes:
        rest: Shape ``(Q,)``: their columns in the table. Of delays that no log tells apart, the sensor's is held.
        precision: Shape ``(Q, Q)``.
    """

    rest: np.ndarray
    precision: np.ndarray

    @staticmethod
    def of(table: ParameterTable, posterior: Posterior | None) -> Knowledge:
        """Return what an identification left open; without one, a uniform distribution within the bounds."""
        shift = time_shift(table)
        rest = np.setdiff1d(np.arange(len(table)), np.flatnonzero(shift > 0)[:1])
        bounds = np.diag(12.0 / table.span**2)
        # Held, not left out: what is known of the rest once the sensor's delay is.
        precision = bounds if posterior is None else np.linalg.inv(posterior.covariance)
        return Knowledge(rest, precision[np.ix_(rest, rest)])

    def deviations(self, information: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the deviations ``(Q,)`` on the scales, with information ``(Q, Q)`` of further recordings."""
        return np.sqrt(np.diag(np.linalg.inv(self.precision + information)))


def informations(problem: Problem, at: Linearised, known: Knowledge) -> np.ndarray:
    """Return the information of each fitted segment, ``(S, Q, Q)``, if residuals had a variance of 1.

    Args:
        problem: The residuals.
        at: Their Jacobian.
        known: Says of which parameters.
    """
    J = at.jacobian.reshape(len(problem.train), -1, len(at.x))[:, :, known.rest]
    return np.einsum("snp,snq->spq", J, J)


def choose(known: np.ndarray, each: np.ndarray, variance: np.ndarray, count: int) -> list[int]:
    """Return which motions to play, the one that adds most first; none twice.

    One after the other, each with all that were chosen before; then each is exchanged for another one as long as that
    helps (Fedorov, Theory of Optimal Experiments, 1972). A fit weighs all residuals alike: so their mean variance
    counts, and a motion that is quick, and so seen badly, makes what all others tell less sure.

    Args:
        known: Shape ``(Q, Q)``: the information there is.
        each: Shape ``(M, Q, Q)``: information of each motion, if residuals had a variance of 1.
        variance: Shape ``(M,)``: mean variance of the residuals of each.
        count: How many to choose, at most ``M``.
    """

    def best(others: list[int], among: Sequence[int]) -> int:
        means = (variance[others].sum() + variance[list(among)]) / (len(others) + 1)
        told = (each[others].sum(axis=0) + each[list(among)]) / means[:, None, None]
        return among[int(np.argmax(np.linalg.slogdet(known + told)[1]))]

    every = range(len(each))
    chosen: list[int] = []
    while len(chosen) < count:
        chosen.append(best(chosen, [i for i in every if i not in chosen]))
    for _ in range(3 * count):
        before = list(chosen)
        for place in range(count):
            others = chosen[:place] + chosen[place + 1 :]
            chosen[place] = best(others, [i for i in every if i not in others])
        if chosen == before:
            break
    ordered: list[int] = []
    while len(ordered) < count:
        ordered.append(best(ordered, [i for i in chosen if i not in ordered]))
    return ordered
