"""The distribution of delays that no time stamp records, estimated from the motion together with the dynamics.

A measurement with stamp t shows the motion at t - d. The model predicts the motion; where it is fast, a measurement
determines d well. The likelihood of a measurement is a sum over a grid of delays: the share of each delay times the
density of the measurement at that delay. Parameters of the dynamics, initial states, the drift of the clock, the noise
and the shares maximise the product over all measurements.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim2real.identification.delay_likelihood import FLOOR, DelayEvidence, Likelihood, along, covariance, maximise

_FIRST_S = 0.005
"""Assumed deviation of delays before the first estimate [s]."""
_PARTS = 1.0, 0.25, 0.0625
"""Parts of a step of least squares that are tried."""
_APART, _TRIES = 2.0, 5
"""Distance of the mean delays at which the likelihood's maximum is looked for, in standard errors of the first
estimate, and the most of them on a side."""
_LEAST, _MOST = 40, 100
"""Points of the final grid."""
Linearise = Callable[[np.ndarray, float], DelayEvidence]
"""From the unknowns ``(P,)`` and a delay [s] to the linearised measurements."""


@dataclass(frozen=True)
class Hidden:
    """The estimated distribution of delays.

    Attributes:
        x: Shape ``(P,)``: the unknowns.
        drift: Rate of the measurements' clock minus 1 [s/s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
        delays: Shape ``(K,)``: a grid of delays, in the middle of the recording [s].
        share: Shape ``(K,)``: share of the measurements that have each delay.
        mean_error: Standard error of the mean by least squares, which assume no shape of the distribution [s].
        by_shape: Shape ``(K, M)``: d share / d weight of the splines.
        covariance: Of unknowns, logarithms of the noise and weights of the splines, in this order.
        place: The point of the largest likelihood, in the same order; 0 for unknowns, as offsets from ``x``.
    """

    x: np.ndarray
    drift: float
    drift_error: float
    noise: np.ndarray
    delays: np.ndarray
    share: np.ndarray
    mean_error: float
    by_shape: np.ndarray
    covariance: np.ndarray
    place: np.ndarray

    @property
    def mean(self) -> tuple[float, float]:
        """The mean delay and its standard error [s].

        The error is at least that of least squares. The likelihood's own is too small where the distribution has edges
        that the splines cannot follow.
        """
        return float(self.share @ self.delays), max(self._error(self.delays @ self.by_shape), self.mean_error)

    @property
    def deviation(self) -> tuple[float, float]:
        """The standard deviation of the delay, and its standard error [s]."""
        off = (self.delays - self.mean[0]) ** 2
        deviation = float(np.sqrt(self.share @ off))
        return deviation, self._error(off @ self.by_shape / (2 * max(deviation, 1e-9)))

    def quantile(self, q: float, deviations: float) -> tuple[float, float, float]:
        """Return the delay that a share ``q`` of the messages does not exceed, and the ends of its interval [s].

        The ends are the quantiles at ``q`` minus and plus the error of the distribution there: a quantile within a gap
        of the distribution has no standard error. Two things widen the interval: the part of the mean's error that the
        likelihood lacks, and half a step of the grid, its resolution.
        """
        below = np.cumsum(self.share) - 0.5 * self.share
        error = self._error(np.array(_at(self._below(), below, q)))
        ends = np.interp([q, q - deviations * error, q + deviations * error], below, self.delays)
        whole, half = self.mean[1], 0.5 * float(self.delays[1] - self.delays[0])
        shift = deviations * np.sqrt(whole**2 - min(self._error(self.delays @ self.by_shape), whole) ** 2)
        reach = np.hypot(np.abs(ends[1:] - ends[0]), shift) + half
        return float(ends[0]), float(ends[0] - reach[0]), float(ends[0] + reach[1])

    def _below(self) -> np.ndarray:
        return np.cumsum(self.by_shape, axis=0) - 0.5 * self.by_shape

    def _error(self, slope: np.ndarray) -> float:
        block = self.covariance[-len(slope) :, -len(slope) :]
        return float(np.sqrt(max(slope @ block @ slope, 0.0)))


def _at(rows: np.ndarray, where: np.ndarray, q: float) -> list[float]:
    return [float(np.interp(q, where, column)) for column in rows.T]


@dataclass(frozen=True)
class _At:
    """The present point of the search: unknowns, drift [s/s], noise, and shares of the delays."""

    x: np.ndarray
    drift: float
    noise: np.ndarray
    delays: np.ndarray
    share: np.ndarray

    @property
    def mean_s(self) -> float:
        return float(self.share @ self.delays)

    @property
    def deviation_s(self) -> float:
        return float(np.sqrt(self.share @ (self.delays - self.mean_s) ** 2))


def hidden(linearise: Linearise, x: np.ndarray, delay_s: float) -> Hidden:
    """Estimate delays, drift, noise and the unknowns of a model together.

    Args:
        linearise: The model; called in every round with the unknowns and the mean delay.
        x: Shape ``(P,)``: a first estimate of the unknowns.
        delay_s: A first estimate of the mean delay [s].
    """
    # First estimates by least squares; a step that does not lower the errors is taken in part.
    size, drift, error_s, evidence = len(x), 0.0, 0.0, linearise(x, delay_s)
    ones, first = np.ones(evidence.errors.shape[1]), _local(evidence, x, drift, delay_s)
    for _ in range(3):
        move, errors = straight(evidence, drift, delay_s, _FIRST_S, ones)
        error_s = float(errors[0])
        least = _squares(evidence, drift, delay_s, ones)
        for part in _PARTS:
            there = np.append(x, (delay_s, drift)) + part * move
            there[size] = np.clip(there[size], evidence.delays[0], evidence.delays[-1])
            new = linearise(there[:size], float(there[size]))
            if _squares(new, float(there[-1]), float(there[size]), ones) < least:
                evidence, x, (delay_s, drift) = new, there[:size], there[size:].tolist()
                break
        else:
            break

    # The likelihood has many maxima: start from delays on both sides, too, and go further while it gets larger.
    begins = delay_s + _APART * error_s * np.arange(-_TRIES, _TRIES + 1)
    local = functools.cache(lambda k: _local(evidence, x, drift, float(begins[_TRIES + k])))
    best, step = 0, 1 if local(1)[0] > local(-1)[0] else -1
    while abs(best) < _TRIES and local(best + step)[0] > local(best)[0]:
        best += step

    # Linearise twice more, from the best of these and from the caller's estimate: far steps may have looked too good.
    ends = [_climb(linearise, _climb(linearise, start)[0]) for _, start in (first, local(best))]
    at, likelihood, p = max(ends, key=lambda end: end[1](end[2])[0])

    # Errors of the estimate.
    _, (mean_error, drift_error) = straight(likelihood.evidence, at.drift, at.mean_s, at.deviation_s, at.noise)
    by_shape = at.share[:, None] * (likelihood.bumps - at.share @ likelihood.bumps)
    spread = covariance(likelihood, likelihood(p)[1])
    place = np.where(np.arange(p.size) < size, 0.0, p)
    return Hidden(at.x, at.drift, drift_error, at.noise, at.delays, at.share, mean_error, by_shape, spread, place)


def _local(evidence: DelayEvidence, x: np.ndarray, drift: float, delay_s: float) -> tuple[float, _At]:
    """Return the largest likelihood near a mean delay [s], and where it is, without another linearisation."""
    # Take the unknowns that fit best with that delay, then each delay's share, then the smooth distribution.
    delay_s = float(np.clip(delay_s, evidence.delays[0], evidence.delays[-1]))
    columns, rest = _weighed(evidence, drift, delay_s, _FIRST_S, np.ones(evidence.errors.shape[1]))
    J = columns[:, :, : len(x)].reshape(-1, len(x))
    at = rough(evidence, x, -np.linalg.solve(J.T @ J + evidence.prior + 1e-12 * np.eye(len(x)), J.T @ rest.ravel()))
    likelihood = Likelihood(evidence, _support(evidence, at.share, at.noise), drift)
    p = likelihood.start(at.noise, np.full(len(likelihood.grid), 1.0 / len(likelihood.grid)))
    p[: len(x)] = at.x - x
    p = maximise(likelihood, p)
    return likelihood(p)[0], _reached(likelihood, p, x)


def _climb(linearise: Linearise, at: _At) -> tuple[_At, Likelihood, np.ndarray]:
    """Linearise the model and maximise the likelihood.

    Returns:
        The end, the likelihood, and its parameters there.
    """
    evidence = linearise(at.x, at.mean_s)
    drift = at.drift + float(straight(evidence, at.drift, at.mean_s, at.deviation_s, at.noise)[0][-1])
    likelihood = Likelihood(evidence, at.delays, drift)
    p = maximise(likelihood, likelihood.start(at.noise, at.share))
    return _reached(likelihood, p, at.x), likelihood, p


def _reached(likelihood: Likelihood, p: np.ndarray, x: np.ndarray) -> _At:
    """Return a point of the likelihood, whose unknowns are offsets from ``x (P,)``."""
    noise = np.exp(p[likelihood.unknowns : likelihood.unknowns + likelihood.fields])
    moved = x + p[: likelihood.unknowns]
    return _At(moved, likelihood.drift, noise, likelihood.grid, likelihood.shares(p))


def straight(
    evidence: DelayEvidence, drift: float, delay_s: float, deviation_s: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return corrections ``(P + 2,)`` of unknowns, mean delay and drift by least squares, and errors of the last two.

    The drift is estimated here and not by the likelihood, which gives most weight to the few messages at the edges of
    a distribution and has many maxima of nearly the same height.

    Args:
        drift: A first estimate of the drift [s/s].
        delay_s: The mean delay [s].
        deviation_s: The deviation of delays [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """
    columns, rest = _weighed(evidence, drift, delay_s, deviation_s, noise)
    size = columns.shape[2]
    prior = 1e-12 * np.eye(size)
    prior[:-2, :-2] += evidence.prior
    inverse = np.linalg.inv(np.einsum("nfp,nfq->pq", columns, columns) + prior)
    move = -inverse @ np.einsum("nfp,nf->p", columns, rest)
    gradient = np.einsum("nfp,nf->np", columns, rest + columns @ move)
    return move, np.sqrt(np.diag(inverse @ along(gradient) @ inverse)[-2:])


def _squares(evidence: DelayEvidence, drift: float, delay_s: float, noise: np.ndarray) -> float:
    return float((_weighed(evidence, drift, delay_s, _FIRST_S, noise)[1] ** 2).sum())


def _weighed(
    evidence: DelayEvidence, drift: float, delay_s: float, deviation_s: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns ``(N, F, P + 2)`` of unknowns, delay and drift for least squares, and the errors ``(N, F)``."""
    errors, slopes = evidence.at((delay_s + drift * evidence.stamps)[:, None])
    weight = 1.0 / np.sqrt(noise**2 + (slopes[:, :, 0] * deviation_s) ** 2)
    columns = np.concatenate([evidence.jacobian, slopes, slopes * evidence.stamps[:, None, None]], axis=2)
    return columns * weight[:, :, None], errors[:, :, 0] * weight


def rough(evidence: DelayEvidence, x: np.ndarray, move: np.ndarray, steps: int = 40) -> _At:
    """Return an approximate maximum of the likelihood, by expectation and maximisation with a share for every delay.

    Args:
        x: Shape ``(P,)``: the unknowns there.
        move: Shape ``(P,)``: the start, as an offset from ``x``.
    """
    count, fields, size = evidence.errors.shape
    share, noise = np.full(size, 1.0 / size), np.ones(fields)
    for _ in range(steps):
        # Expectation: the probability of each delay for each measurement.
        off = (evidence.errors + (evidence.jacobian @ move)[:, :, None]) / noise[None, :, None]
        height = -0.5 * (off**2).sum(axis=1) + np.log(share + FLOOR)
        likely = np.exp(height - height.max(axis=1, keepdims=True))
        likely /= likely.sum(axis=1, keepdims=True)

        # Maximisation: shares, unknowns and noise.
        share = likely.sum(axis=0) / count
        J = (evidence.jacobian / noise[None, :, None]).reshape(-1, len(move))
        error = (np.einsum("nk,nfk->nf", likely, evidence.errors) / noise).reshape(-1)
        move = -np.linalg.solve(J.T @ J + evidence.prior + 1e-12 * np.eye(len(move)), J.T @ error)
        off = evidence.errors + (evidence.jacobian @ move)[:, :, None]
        noise = np.sqrt(np.einsum("nk,nfk->f", likely, off**2) / count)
    return _At(x + move, 0.0, noise, evidence.delays, share)


def _support(evidence: DelayEvidence, share: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return a grid of delays that covers those of all messages, finer than the resolution of a measurement."""
    below, few = np.cumsum(share), 0.3 / len(evidence.stamps)
    step = evidence.delays[1] - evidence.delays[0]
    low, high = np.interp([few, 1 - few], below, evidence.delays) + np.array([-step, step])
    slopes = np.abs(np.diff(evidence.errors, axis=2)).mean(axis=2) / step / noise
    fine = 0.7 / max(float(np.quantile(np.sqrt((slopes**2).sum(axis=1)), 0.95)), 1e-9)
    return np.linspace(low, high, int(np.clip((high - low) / fine, _LEAST, _MOST)))
