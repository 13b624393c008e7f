"""The distribution of delays that no time stamp records, estimated from the motion together with the dynamics.

A measurement with stamp t shows the motion at t - d. The model predicts the motion; where it is fast, a measurement
determines d well. The likelihood of a measurement is a sum over a grid of delays: the share of each delay times the
density of the measurement at that delay. Parameters of the dynamics, initial states, the drift of the clock, the noise
and the shares maximise the product over all measurements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim2real.identify.delays.likelihood import FLOOR, Likelihood, Seen, along, covariance, maximise

_FIRST_S = 0.005
"""What delays may deviate by, as long as nothing is known of them [s]."""
_LEAST, _MOST = 40, 100
"""Points of the final grid."""
Linearise = Callable[[np.ndarray, float], Seen]
"""From the unknowns ``(P,)`` and a delay [s] to what is seen there."""


@dataclass(frozen=True)
class Hidden:
    """What was found.

    Attributes:
        x: Shape ``(P,)``: the unknowns.
        drift: How much faster the measurements' clock runs [s/s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
        delays: Shape ``(K,)``: a grid of delays, in the middle of the recording [s].
        share: Shape ``(K,)``: share of the measurements that have each delay.
        by_shape: Shape ``(K, M)``: d share / d weight of the splines.
        covariance: Of unknowns, logarithms of the noise and weights of the splines, in this order.
        place: Where the likelihood is largest, in the same order; 0 for unknowns, as they are counted from ``x``.
    """

    x: np.ndarray
    drift: float
    drift_error: float
    noise: np.ndarray
    delays: np.ndarray
    share: np.ndarray
    by_shape: np.ndarray
    covariance: np.ndarray
    place: np.ndarray

    @property
    def mean(self) -> tuple[float, float]:
        """The mean delay and its standard error [s]."""
        return float(self.share @ self.delays), self._error(self.delays @ self.by_shape)

    @property
    def deviation(self) -> tuple[float, float]:
        """The standard deviation of the delay, and its standard error [s]."""
        off = (self.delays - self.mean[0]) ** 2
        deviation = float(np.sqrt(self.share @ off))
        return deviation, self._error(off @ self.by_shape / (2 * max(deviation, 1e-9)))

    def quantile(self, q: float, deviations: float) -> tuple[float, float, float]:
        """Return the delay that a share ``q`` of the messages does not exceed, and the ends of its interval [s].

        The ends are where the distribution passes ``q`` less and more its error: a quantile within a gap of the
        distribution has no standard error of its own.
        """
        below = np.cumsum(self.share) - 0.5 * self.share
        error = self._error(np.array(_at(self._below(), below, q)))
        ends = np.interp([q, q - deviations * error, q + deviations * error], below, self.delays)
        return float(ends[0]), float(ends[1]), float(ends[2])

    def _below(self) -> np.ndarray:
        return np.cumsum(self.by_shape, axis=0) - 0.5 * self.by_shape

    def _error(self, slope: np.ndarray) -> float:
        own = self.covariance[-len(slope) :, -len(slope) :]
        return float(np.sqrt(max(slope @ own @ slope, 0.0)))


def _at(rows: np.ndarray, where: np.ndarray, q: float) -> list[float]:
    return [float(np.interp(q, where, column)) for column in rows.T]


@dataclass(frozen=True)
class _At:
    """Where the search is: unknowns, drift [s/s], noise, and shares of the delays."""

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
    """Find delays, drift, noise and the unknowns of a model together.

    Args:
        linearise: The model: called with the unknowns and about the mean delay, in every round.
        x: Shape ``(P,)``: about the unknowns.
        delay_s: About the mean delay [s].
    """
    size, drift = len(x), 0.0
    for _ in range(3):
        seen = linearise(x, delay_s)
        move, _ = straight(seen, drift, delay_s, _FIRST_S, np.ones(seen.errors.shape[1]))
        x, drift = x + move[:size], drift + float(move[-1])
        delay_s = float(np.clip(delay_s + move[size], seen.delays[0], seen.delays[-1]))
    seen = linearise(x, delay_s)
    at = rough(seen, x)
    at, _, _ = _climb(linearise, at, _support(seen, at.share, at.noise))
    at, likelihood, p = _climb(linearise, at)
    _, error = straight(likelihood.seen, at.drift, at.mean_s, at.deviation_s, at.noise)
    by_shape = at.share[:, None] * (likelihood.bumps - at.share @ likelihood.bumps)
    spread = covariance(likelihood, likelihood(p)[1])
    place = np.where(np.arange(p.size) < size, 0.0, p)
    return Hidden(at.x, at.drift, error, at.noise, at.delays, at.share, by_shape, spread, place)


def _climb(linearise: Linearise, at: _At, grid: np.ndarray | None = None) -> tuple[_At, Likelihood, np.ndarray]:
    """Linearise the model and maximise the likelihood; a new grid begins with equal shares.

    Returns:
        The end, the likelihood, and its parameters there.
    """
    seen = linearise(at.x, at.mean_s)
    drift = at.drift + float(straight(seen, at.drift, at.mean_s, at.deviation_s, at.noise)[0][-1])
    share = at.share if grid is None else np.full(len(grid), 1.0 / len(grid))
    likelihood = Likelihood(seen, at.delays if grid is None else grid, drift)
    p = maximise(likelihood, likelihood.start(at.noise, share))
    noise = np.exp(p[likelihood.unknowns : likelihood.unknowns + likelihood.fields])
    x = at.x + p[: likelihood.unknowns]
    return _At(x, drift, noise, likelihood.grid, likelihood.shares(p)), likelihood, p


def straight(
    seen: Seen, drift: float, delay_s: float, deviation_s: float, noise: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return how far unknowns, mean delay and drift are off ``(P + 2,)`` by least squares, and the drift's error [s/s].

    The drift is found by this alone, not by the likelihood: that gives most weight to the few messages at the edges of
    a distribution, and climbs to one of many maxima of nearly the same height.

    Args:
        drift: About the drift [s/s].
        delay_s: The mean delay [s].
        deviation_s: The deviation of delays [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """
    errors, slopes = seen.at((delay_s + drift * seen.stamps)[:, None])
    weight = 1.0 / np.sqrt(noise**2 + (slopes[:, :, 0] * deviation_s) ** 2)
    columns = np.concatenate([seen.jacobian, slopes, slopes * seen.stamps[:, None, None]], axis=2) * weight[:, :, None]
    size = columns.shape[2]
    prior = np.zeros((size, size))
    prior[:-2, :-2] = seen.prior
    rest = errors[:, :, 0] * weight
    inverse = np.linalg.inv(np.einsum("nfp,nfq->pq", columns, columns) + prior)
    move = -inverse @ np.einsum("nfp,nf->p", columns, rest)
    gradient = np.einsum("nfp,nf->np", columns, rest + columns @ move)
    return move, float(np.sqrt((inverse @ along(gradient) @ inverse)[-1, -1]))


def rough(seen: Seen, x: np.ndarray, steps: int = 40) -> _At:
    """Return roughly where the likelihood is largest, by expectation and maximisation with a share for every delay.

    Args:
        x: Shape ``(P,)``: the unknowns there.
    """
    count, fields, size = seen.errors.shape
    move, share = np.zeros(seen.jacobian.shape[2]), np.full(size, 1.0 / size)
    noise = np.ones(fields)
    for _ in range(steps):
        off = (seen.errors + (seen.jacobian @ move)[:, :, None]) / noise[None, :, None]
        height = -0.5 * (off**2).sum(axis=1) + np.log(share + FLOOR)
        likely = np.exp(height - height.max(axis=1, keepdims=True))
        likely /= likely.sum(axis=1, keepdims=True)
        share = likely.sum(axis=0) / count
        J = (seen.jacobian / noise[None, :, None]).reshape(-1, len(move))
        error = (np.einsum("nk,nfk->nf", likely, seen.errors) / noise).reshape(-1)
        move = -np.linalg.solve(J.T @ J + seen.prior + 1e-12 * np.eye(len(move)), J.T @ error)
        off = seen.errors + (seen.jacobian @ move)[:, :, None]
        noise = np.sqrt(np.einsum("nk,nfk->f", likely, off**2) / count)
    return _At(x + move, 0.0, noise, seen.delays, share)


def _support(seen: Seen, share: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return a grid of delays that covers those of all messages, finer than the resolution of a measurement."""
    below, few = np.cumsum(share), 0.3 / len(seen.stamps)
    step = seen.delays[1] - seen.delays[0]
    low, high = np.interp([few, 1 - few], below, seen.delays) + np.array([-step, step])
    slopes = np.abs(np.diff(seen.errors, axis=2)).mean(axis=2) / step / noise
    fine = 0.7 / max(float(np.quantile(np.sqrt((slopes**2).sum(axis=1)), 0.95)), 1e-9)
    return np.linspace(low, high, int(np.clip((high - low) / fine, _LEAST, _MOST)))
