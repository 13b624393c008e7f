"""The likelihood of measurements whose delays are hidden: a sum over a grid of delays, row by row."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline

_BUMPS = 20
"""Number of splines that form the logarithm of the shares: more of them allow sharper edges."""
_RIDGE = 1e-3
"""Precision of a weak prior on the splines' weights, without which the share of a delay that never occurs is -inf."""
_SMOOTH = 0.5
"""Precision of the weights' third differences: without it, shares of neighbouring delays differ by chance."""
FLOOR = 1e-12
"""Least share of a grid point in the likelihood, so that a single measurement cannot make it infinite."""


@dataclass(frozen=True)
class DelayEvidence:
    """Agreement of measurements with a model's predictions, for every possible delay.

    Attributes:
        stamps: Shape ``(N,)``, in the order of time: the measurements' stamps [s], 0 in the middle of a recording.
        delays: Shape ``(G,)``: delays at equal distances [s].
        errors: Shape ``(N, F, G)``: prediction minus measurement at each delay, in deviations of the measurement.
        jacobian: Shape ``(N, F, P)``: d error / d unknown, near the mean delay.
        prior: Shape ``(P, P)``: precision of the unknowns before the log.
    """

    stamps: np.ndarray
    delays: np.ndarray
    errors: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray

    def rows(self, which: np.ndarray) -> DelayEvidence:
        """Return some of the measurements, ``(N,)`` bool."""
        return replace(self, stamps=self.stamps[which], errors=self.errors[which], jacobian=self.jacobian[which])

    def at(self, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors at other delays ``(N, K)`` [s], and their slope by the delay [1/s]; both ``(N, F, K)``."""
        step = self.delays[1] - self.delays[0]
        place = (delays - self.delays[0]) / step
        left = np.clip(np.floor(place).astype(int), 0, len(self.delays) - 2)
        below = np.take_along_axis(self.errors, left[:, None, :], 2)
        rise = np.take_along_axis(self.errors, left[:, None, :] + 1, 2) - below
        return below + rise * (place - left)[:, None, :], rise / step


class Likelihood:
    """The likelihood of all measurements, and the part of each in its gradient.

    Args:
        grid: Shape ``(K,)``: possible delays of messages, at equal distances [s].
        drift: The drift of the clock [s/s].
    """

    def __init__(self, evidence: DelayEvidence, grid: np.ndarray, drift: float) -> None:
        self.evidence, self.grid, self.drift = evidence, grid, drift
        self.fields, self.unknowns = evidence.jacobian.shape[1:]
        self.bumps = _bumps(grid)
        self.size = self.unknowns + self.fields + self.bumps.shape[1]
        bend = np.diff(np.eye(self.bumps.shape[1]), 3, axis=0)
        self.prior = np.zeros((self.size, self.size))
        self.prior[: self.unknowns, : self.unknowns] = evidence.prior
        self.prior[-bend.shape[1] :, -bend.shape[1] :] = _SMOOTH * bend.T @ bend + _RIDGE * np.eye(bend.shape[1])
        self._errors, slopes = evidence.at(grid[None] + drift * evidence.stamps[:, None])
        # A delay may lie between points of the grid: that adds noise of this variance.
        self._blur = slopes.mean(axis=2) ** 2 * (grid[1] - grid[0]) ** 2 / 12.0

    def start(self, noise: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the start of a search, ``(size,)``, from the noise ``(F,)`` and the shares ``(K,)``."""
        p = np.zeros(self.size)
        p[self.unknowns : self.unknowns + self.fields] = np.log(noise)
        p[-self.bumps.shape[1] :] = np.linalg.lstsq(self.bumps, np.log(np.maximum(share, 1e-9)), rcond=None)[0]
        return p

    def shares(self, p: np.ndarray) -> np.ndarray:
        """Return the share of every delay, ``(K,)``."""
        height = self.bumps @ p[-self.bumps.shape[1] :]
        share = np.exp(height - height.max())
        return share / share.sum()

    def __call__(self, p: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the logarithm of the likelihood and prior, its gradients ``(N, size)`` by row, and its rows ``(N,)``.

        The gradients are those of the likelihood alone.
        """
        # The log likelihood of each measurement at each delay.
        unknowns, evidence = self.unknowns, self.evidence
        variance = np.exp(2 * p[unknowns : unknowns + self.fields])[None]
        total = variance + self._blur
        move = (evidence.jacobian @ p[:unknowns])[:, :, None]
        off = (self._errors + move) / np.sqrt(total)[:, :, None]
        share = self.shares(p)
        height = -0.5 * (off**2).sum(axis=1) - 0.5 * np.log(total).sum(axis=1)[:, None] + np.log(share + FLOOR)

        # The sum over delays, and the probability of each delay.
        top = height.max(axis=1, keepdims=True)
        likely = np.exp(height - top)
        whole = likely.sum(axis=1, keepdims=True)
        likely /= whole
        rows = (np.log(whole) + top)[:, 0]

        # The gradient by unknowns, noise and splines.
        weighed = off / np.sqrt(total)[:, :, None]
        expected = np.einsum("nk,nfk->nf", likely, weighed)
        gradient = np.empty((len(evidence.stamps), self.size))
        gradient[:, :unknowns] = -np.einsum("nf,nfp->np", expected, evidence.jacobian)
        squares = np.einsum("nk,nfk->nf", likely, off**2)
        gradient[:, unknowns : unknowns + self.fields] = (squares - 1) * variance / total
        gradient[:, unknowns + self.fields :] = (likely - share) @ self.bumps
        return float(rows.sum() - 0.5 * p @ self.prior @ p), gradient, rows


def maximise(likelihood: Likelihood, p: np.ndarray, steps: int = 40) -> np.ndarray:
    """Maximise the likelihood by damped steps with the information matrix of the rows' gradients.

    Solvers of scipy do not use these gradients.

    Args:
        p: Shape ``(size,)``: the start.
    """
    value, gradient, _ = likelihood(p)
    damping = 1e-3
    for _ in range(steps):
        information = gradient.T @ gradient + likelihood.prior
        uphill = gradient.sum(axis=0) - likelihood.prior @ p
        scale = np.diag(np.diag(information) + 1e-12)
        while True:
            moved = p + np.linalg.solve(information + damping * scale, uphill)
            new, new_gradient, _ = likelihood(moved)
            if new >= value:
                break
            damping *= 5
            if damping > 1e6:
                return p
        damping = max(damping / 5, 1e-6)
        gain, p, value, gradient = new - value, moved, new, new_gradient
        if gain < 1e-4:
            break
    return p


def covariance(likelihood: Likelihood, gradient: np.ndarray) -> np.ndarray:
    """Return the covariance of the estimate, ``(size, size)``.

    Delays of successive messages depend on each other: a timer's rise and fall periodically, a busy bus's stay long.
    So products of gradients of messages up to a few steps apart are added (Newey and West, Econometrica 55, 1987).

    Args:
        gradient: Shape ``(N, size)``: its rows' gradients at the maximum.
    """
    count = len(gradient)
    inverse = np.linalg.inv(gradient.T @ gradient + likelihood.prior)
    spread = inverse @ (along(gradient) + likelihood.prior) @ inverse
    return spread * count / max(count - likelihood.unknowns / likelihood.fields, 1.0)


def along(gradient: np.ndarray) -> np.ndarray:
    """Return the covariance of the sum of rows ``(N, size)`` that follow each other in time, ``(size, size)``."""
    lags = round(len(gradient) ** (1 / 3))
    between = gradient.T @ gradient
    for lag in range(1, lags + 1):
        product = gradient[lag:].T @ gradient[:-lag]
        between += (1 - lag / (lags + 1)) * (product + product.T)
    return between


def _bumps(grid: np.ndarray) -> np.ndarray:
    """Return cubic splines on the grid, ``(K, M)``."""
    inner = np.linspace(0.0, 1.0, _BUMPS - 1)
    knots = np.concatenate([np.zeros(3), inner, np.ones(3)])
    place = np.clip((grid - grid[0]) / (grid[-1] - grid[0]), 0.0, 1.0 - 1e-12)
    return BSpline.design_matrix(place, knots, 3).toarray()
