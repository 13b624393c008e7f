"""Estimates the delay of measurements, which no stamp records: mean, 95th percentile, deviation, lost messages.

A measurement with stamp t shows the motion at t - d. The model predicts the motion; where it is fast, a measurement
determines d well. The likelihood of a measurement is a sum over a grid of delays: the share of each delay times the
density of the measurement at that delay. The dynamics, the initial states, the noise and the shares maximise the
product over all measurements. The commands' delay moves the motion as a whole: its mean adds to that of the
measurements, and a log determines only the sum.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import Link, Ranged
from sim2real.errors import UsageError
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Problem

_STEP_S = 0.001
"""Step between the delays at which the motion is predicted [s]."""
_LOST = 0.5
"""A repeated value counts as a lost message from this probability on; otherwise it counts as a message with a delay."""
_WIDTH = 1.96
"""Half the width of a 95 % interval, in standard errors."""
_BUMPS = 20
"""Number of splines whose sum is the logarithm of the shares: more of them allow sharper edges."""
_RIDGE, _SMOOTH = 1e-3, 0.5
"""Precisions of the priors of the splines' weights, and of the weights' third differences. Without the first, the log
share of a delay that never occurs is -inf; without the second, shares of neighbouring delays differ by chance.
"""
_FLOOR = 1e-12
"""Least share of a grid point in the likelihood, so that a single measurement cannot make it infinite."""
_FIRST_S = 0.005
"""Assumed standard deviation of the delays before the first estimate [s]."""
_PARTS = 1.0, 0.25, 0.0625
"""Shares of a step of least squares that are tried."""
_APART, _TRIES = 2.0, 5
"""Maxima of the likelihood are looked for at mean delays this far apart, in standard errors of the first estimate; and
at how many of them, at most, on each side.
"""
_ROUNDS, _AGAIN = 3, 2
"""Number of linearisations for least squares, and for the likelihood after it."""
_STEPS = 40
"""Most steps of a maximisation."""
_LEAST, _MOST = 40, 100
"""Points of the grid of shares."""


@dataclass(frozen=True)
class DelayEvidence:
    """Agreement of measurements with a model's predictions, for every possible delay.

    Attributes:
        delays: Shape ``(G,)``: delays at equal distances [s].
        errors: Shape ``(N, F, G)``: prediction minus measurement at each delay, in deviations of the measurement; in
            the order of time.
        jacobian: Shape ``(N, F, P)``: d error / d unknown, near the mean delay.
        prior: Shape ``(P, P)``: precision of the unknowns before the log.
    """

    delays: np.ndarray
    errors: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray

    def rows(self, which: np.ndarray) -> "DelayEvidence":
        """Return some of the measurements, ``(N,)`` bool."""
        return replace(self, errors=self.errors[which], jacobian=self.jacobian[which])

    def at(self, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors at other delays ``(K,)`` [s], and their derivative by the delay [1/s]; both ``(N, F, K)``."""
        step = self.delays[1] - self.delays[0]
        place = (delays - self.delays[0]) / step
        left = np.clip(np.floor(place).astype(int), 0, len(self.delays) - 2)
        rise = self.errors[:, :, left + 1] - self.errors[:, :, left]
        return self.errors[:, :, left] + rise * (place - left), rise / step


Linearise = Callable[[np.ndarray, float], DelayEvidence]
"""Maps the unknowns ``(P,)`` and a delay [s] to the linearised measurements."""


class Likelihood:
    """The likelihood of all measurements at a point ``(size,)``: changes of the unknowns, log noise, splines' weights.

    Args:
        grid: Shape ``(K,)``: possible delays of messages, at equal distances [s].
    """

    def __init__(self, evidence: DelayEvidence, grid: np.ndarray) -> None:
        from scipy.interpolate import BSpline  # imported late: it takes 0.6 s, and few identifications estimate links

        self.evidence, self.grid = evidence, grid
        self.fields, self.unknowns = evidence.jacobian.shape[1:]
        knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, _BUMPS - 1), np.ones(3)])
        place = np.clip((grid - grid[0]) / (grid[-1] - grid[0]), 0.0, 1.0 - 1e-12)
        self.bumps = BSpline.design_matrix(place, knots, 3).toarray()
        self.size = self.unknowns + self.fields + self.bumps.shape[1]
        bend = np.diff(np.eye(self.bumps.shape[1]), 3, axis=0)
        self.prior = np.zeros((self.size, self.size))
        self.prior[: self.unknowns, : self.unknowns] = evidence.prior
        self.prior[-bend.shape[1] :, -bend.shape[1] :] = _SMOOTH * bend.T @ bend + _RIDGE * np.eye(bend.shape[1])
        self._errors, slopes = evidence.at(grid)
        # A delay between two points of the grid adds noise of this variance.
        self._blur = slopes.mean(axis=2) ** 2 * (grid[1] - grid[0]) ** 2 / 12.0

    def start(self, noise: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the point ``(size,)`` with noise ``(F,)`` and shares ``(K,)``."""
        weights = np.linalg.lstsq(self.bumps, np.log(np.maximum(share, 1e-9)), rcond=None)[0]
        return np.concatenate([np.zeros(self.unknowns), np.log(noise), weights])

    def noise(self, p: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the noise, ``(F,)``."""
        return np.exp(p[self.unknowns : self.unknowns + self.fields])

    def shares(self, p: np.ndarray) -> np.ndarray:
        """Return the share of every delay, ``(K,)``."""
        height = self.bumps @ p[-self.bumps.shape[1] :]
        share = np.exp(height - height.max())
        return share / share.sum()

    def __call__(self, p: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log posterior; and each row's log likelihood as gradient ``(N, size)`` and value ``(N,)``."""
        # The log likelihood of each measurement at each delay.
        unknowns, variance, share = self.unknowns, self.noise(p)[None] ** 2, self.shares(p)
        total = variance + self._blur
        move = (self.evidence.jacobian @ p[:unknowns])[:, :, None]
        off = (self._errors + move) / np.sqrt(total)[:, :, None]
        height = -0.5 * (off**2).sum(axis=1) - 0.5 * np.log(total).sum(axis=1)[:, None] + np.log(share + _FLOOR)
        # The sum over delays, and the probability of each delay.
        top = height.max(axis=1, keepdims=True)
        likely = np.exp(height - top)
        whole = likely.sum(axis=1, keepdims=True)
        likely /= whole
        rows = (np.log(whole) + top)[:, 0]
        # The gradient by unknowns, noise and weights.
        expected = np.einsum("nk,nfk->nf", likely, off) / np.sqrt(total)
        squares = np.einsum("nk,nfk->nf", likely, off**2)
        of_unknowns = -np.einsum("nf,nfp->np", expected, self.evidence.jacobian)
        gradient = np.hstack([of_unknowns, (squares - 1) * variance / total, (likely - share) @ self.bumps])
        return float(rows.sum() - 0.5 * p @ self.prior @ p), gradient, rows

    def maximise(self, p: np.ndarray) -> np.ndarray:
        """Return the maximum near a start, by damped steps; products of the rows' gradients are the curvature."""
        value, gradient, _ = self(p)
        damping = 1e-3
        for _ in range(_STEPS):
            information = gradient.T @ gradient + self.prior
            uphill = gradient.sum(axis=0) - self.prior @ p
            scale = np.diag(np.diag(information) + 1e-12)
            while True:
                moved = p + np.linalg.solve(information + damping * scale, uphill)
                new, new_gradient, _ = self(moved)
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

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Return the covariance of the estimate at the maximum, ``(size, size)``."""
        gradient = self(p)[1]
        inverse = np.linalg.inv(gradient.T @ gradient + self.prior)
        spread = inverse @ (_along(gradient) + self.prior) @ inverse
        return spread * len(gradient) / max(len(gradient) - self.unknowns / self.fields, 1.0)


def _along(gradient: np.ndarray) -> np.ndarray:
    """Return the covariance ``(size, size)`` of the sum of rows ``(N, size)`` that follow each other in time.

    Delays of successive messages depend on each other: behind a timer they rise and fall periodically, on a busy bus
    they stay long. So products of rows up to a few steps apart are added (Newey and West, Econometrica 55, 1987).
    """
    lags = round(len(gradient) ** (1 / 3))
    between = gradient.T @ gradient
    for lag in range(1, lags + 1):
        product = gradient[lag:].T @ gradient[:-lag]
        between += (1 - lag / (lags + 1)) * (product + product.T)
    return between


def _straight(
    evidence: DelayEvidence, delay_s: float, deviation_s: float, noise: np.ndarray, move_delay: bool = True
) -> tuple[np.ndarray, float, float]:
    """Return corrections ``(P + 1,)`` of unknowns and mean delay, the delay's standard error, and the sum of squares.

    Args:
        noise: Shape ``(F,)``: standard deviation of the noise, relative to the assumed one of the measurement.
        move_delay: False: the delay is fixed.
    """
    errors, slopes = evidence.at(np.array([delay_s]))
    weight = 1.0 / np.sqrt(noise**2 + (slopes[:, :, 0] * deviation_s) ** 2)
    columns, rest = np.concatenate([evidence.jacobian, slopes], axis=2) * weight[:, :, None], errors[:, :, 0] * weight
    prior = 1e-12 * np.eye(columns.shape[2])
    prior[:-1, :-1] += evidence.prior
    columns[:, :, -1] *= move_delay
    inverse = np.linalg.inv(np.einsum("nfp,nfq->pq", columns, columns) + prior)
    move = -inverse @ np.einsum("nfp,nf->p", columns, rest)
    gradient = np.einsum("nfp,nf->np", columns, rest + columns @ move)
    return move, float(np.sqrt((inverse @ _along(gradient) @ inverse)[-1, -1])), float((rest**2).sum())


@dataclass(frozen=True)
class Delays:
    """The delays of one stream of measurements.

    Attributes:
        x: Shape ``(P,)``: the unknowns of the model.
        delays: Shape ``(K,)``: a grid of delays [s].
        share: Shape ``(K,)``: share of the measurements that have each delay.
        mean_error: Standard error of the mean by least squares, without an assumption on the distribution [s].
        by_shape: Shape ``(K, M)``: d share / d weight of the splines.
        covariance: Shape ``(M, M)``: covariance of the weights.
        place: Shape ``(F + M,)``: logarithms of the noise, and the weights of the splines.
        lost: Shape ``(N,)``: the probability that each message was lost.
    """

    x: np.ndarray
    delays: np.ndarray
    share: np.ndarray
    mean_error: float
    by_shape: np.ndarray
    covariance: np.ndarray
    place: np.ndarray
    lost: np.ndarray

    @property
    def mean_s(self) -> float:
        """The mean delay [s]."""
        return float(self.share @ self.delays)

    def ranged(self, held_s: float = 0.0) -> tuple[Ranged, Ranged, Ranged]:
        """Return mean, deviation and 95th percentile with their intervals [s].

        The standard error of the mean is the larger of two: by the likelihood, which is too small where the splines
        cannot follow an edge of the distribution, and by least squares. The interval of the percentile ends at the
        quantiles 0.95 minus and plus the error of the distribution there, because a quantile in a gap of the
        distribution has no standard error. It is widened by what least squares add to the mean's error, and by half a
        step of the grid.

        Args:
            held_s: Sum of the other delays, which is added to the mean and to the percentile [s].
        """
        likely = self._error(self.delays @ self.by_shape)
        error = max(likely, self.mean_error)
        off = (self.delays - self.mean_s) ** 2
        deviation = float(np.sqrt(self.share @ off))
        of_deviation = self._error(off @ self.by_shape / (2 * max(deviation, 1e-9)))
        below = np.cumsum(self.share) - 0.5 * self.share
        slopes = np.cumsum(self.by_shape, axis=0) - 0.5 * self.by_shape
        there = self._error(np.array([np.interp(0.95, below, column) for column in slopes.T]))
        p95, *ends = np.interp([0.95, 0.95 - _WIDTH * there, 0.95 + _WIDTH * there], below, self.delays)
        lacks = _WIDTH * np.sqrt(error**2 - likely**2)
        low, high = np.hypot(np.abs(np.array(ends) - p95), lacks) + 0.5 * (self.delays[1] - self.delays[0])
        rows = (
            (self.mean_s + held_s, _WIDTH * error, _WIDTH * error),
            (deviation, _WIDTH * of_deviation, _WIDTH * of_deviation),
            (float(p95) + held_s, float(low), float(high)),
        )
        first, second, third = (Ranged(v, max(v - low, 0.0), v + high) for v, low, high in rows)
        return first, second, third

    def _error(self, slope: np.ndarray) -> float:
        return float(np.sqrt(max(slope @ self.covariance @ slope, 0.0)))


def _arrived(linearise: Linearise, x: np.ndarray, delay_s: float) -> Delays:
    """Estimate delays, noise and unknowns together, as if no message was lost.

    Args:
        linearise: Called in every round with the unknowns and the mean delay.
        x: Shape ``(P,)``: a first estimate of the unknowns.
        delay_s: A first estimate of the mean delay [s].
    """
    # First estimates by least squares; a step that does not lower the errors is shortened.
    evidence = linearise(x, delay_s)
    ones, first = np.ones(evidence.errors.shape[1]), (_maximum(evidence, delay_s), x)
    for _ in range(_ROUNDS):
        move, _, least = _straight(evidence, delay_s, _FIRST_S, ones)
        for part in _PARTS:
            there = x + part * move[:-1]
            later_s = float(np.clip(delay_s + part * move[-1], evidence.delays[0], evidence.delays[-1]))
            new = linearise(there, later_s)
            if _straight(new, later_s, _FIRST_S, ones)[2] < least:
                evidence, x, delay_s = new, there, later_s
                break
        else:
            break
    # The likelihood has several maxima: begin at shorter and longer delays, too, and go on while it grows.
    error_s = _straight(evidence, delay_s, _FIRST_S, ones)[1]
    local = functools.cache(lambda k: _maximum(evidence, delay_s + _APART * error_s * k))
    best, step = 0, 1 if local(1)[0] > local(-1)[0] else -1
    while abs(best) < _TRIES and local(best + step)[0] > local(best)[0]:
        best += step
    # Linearise twice more, at the best maximum and near the caller's estimate: far away the linear model may be wrong.
    ends = []
    for (_, likelihood, p), at in (first, (local(best), x)):
        for _ in range(_AGAIN):
            begin, share = likelihood.start(likelihood.noise(p), likelihood.shares(p)), likelihood.shares(p)
            # Shorten a step that lowers the likelihood: where a joint sticks, its initial velocity hardly changes
            # # the motion to first order, and the linearised model moves it too far.
            for part in _PARTS:
                there = at + part * p[: len(x)]
                new = Likelihood(linearise(there, float(share @ likelihood.grid)), likelihood.grid)
                if new(begin)[0] > likelihood(begin)[0]:
                    likelihood, at = new, there
                    break
            p = likelihood.maximise(begin)
        ends.append((likelihood(p)[0], likelihood, p, at))
    _, likelihood, p, at = max(ends, key=lambda end: end[0])
    x, noise, share, grid = at, likelihood.noise(p), likelihood.shares(p), likelihood.grid
    mean_s = float(share @ grid)
    # Errors of the estimate.
    deviation_s = float(np.sqrt(share @ (grid - mean_s) ** 2))
    mean_error = _straight(likelihood.evidence, mean_s, deviation_s, noise)[1]
    by_shape = share[:, None] * (likelihood.bumps - share @ likelihood.bumps)
    covariance = likelihood.covariance(p)[-by_shape.shape[1] :, -by_shape.shape[1] :]
    return Delays(x, grid, share, mean_error, by_shape, covariance, p[len(x) :], np.zeros(len(evidence.errors)))


def _maximum(evidence: DelayEvidence, delay_s: float) -> tuple[float, Likelihood, np.ndarray]:
    """Return the largest likelihood near a mean delay [s], the likelihood, and its point.

    The unknowns begin where they fit best with that delay. Then expectation-maximisation with a free share of every
    delay finds a grid that covers the delays of all messages, and that is finer than a measurement resolves.
    """
    delay_s = float(np.clip(delay_s, evidence.delays[0], evidence.delays[-1]))
    count, fields, size = evidence.errors.shape
    share, noise = np.full(size, 1.0 / size), np.ones(fields)
    move = _straight(evidence, delay_s, _FIRST_S, noise, move_delay=False)[0][:-1]
    for _ in range(_STEPS):
        # Expectation: the probability of each delay for each measurement.
        off = (evidence.errors + (evidence.jacobian @ move)[:, :, None]) / noise[None, :, None]
        height = -0.5 * (off**2).sum(axis=1) + np.log(share + _FLOOR)
        likely = np.exp(height - height.max(axis=1, keepdims=True))
        likely /= likely.sum(axis=1, keepdims=True)
        # Maximisation: shares, unknowns and noise.
        share = likely.sum(axis=0) / count
        J = (evidence.jacobian / noise[None, :, None]).reshape(-1, len(move))
        error = (np.einsum("nk,nfk->nf", likely, evidence.errors) / noise).reshape(-1)
        move = -np.linalg.solve(J.T @ J + evidence.prior + 1e-12 * np.eye(len(move)), J.T @ error)
        off = evidence.errors + (evidence.jacobian @ move)[:, :, None]
        noise = np.sqrt(np.einsum("nk,nfk->f", likely, off**2) / count)
    below, few, step = np.cumsum(share), 0.3 / count, evidence.delays[1] - evidence.delays[0]
    low, high = np.interp([few, 1 - few], below, evidence.delays) + np.array([-step, step])
    slopes = np.abs(np.diff(evidence.errors, axis=2)).mean(axis=2) / step / noise
    fine = 0.7 / max(float(np.quantile(np.sqrt((slopes**2).sum(axis=1)), 0.95)), 1e-9)
    points = int(np.clip((high - low) / fine, _LEAST, _MOST))
    likelihood = Likelihood(evidence, np.linspace(low, high, points))
    p = likelihood.start(noise, np.full(points, 1.0 / points))
    p[: len(move)] = move
    p = likelihood.maximise(p)
    return likelihood(p)[0], likelihood, p


def links(problem: Problem, x: np.ndarray) -> tuple[Link, ...]:
    """Return the link of a problem's measurements.

    Args:
        x: Shape ``(P,)``: the estimate of a fit, from which dynamics and delays are estimated together.

    Raises:
        UsageError: No delay of the measurements is identified.
    """
    late, table = measured(problem.table), problem.table
    # Split the delay evenly between commands and measurements: single measurements may have a shorter delay than the
    # mean.
    values = {n: np.asarray(v, np.float64) for n, v in table.decode(x).items()}
    commands = [c.name for c in table.columns if c.side == "command"]
    half_s = (float(values[late]) + sum(float(values[n]) for n in commands)) / 2.0
    if commands and not table[late].free:
        values = values | {late: np.float64(half_s), commands[0]: np.float64(half_s)}
    watched = _Watched(problem, table.encode(values), late, float(values[late]))
    estimate = find(watched.linearise, watched.x, watched.delay_s, watched.again)
    held_s = sum(float(values[n]) for n in commands)
    grid = estimate.delays + held_s
    numbers = estimate.ranged(held_s)
    return (Link(" + ".join((late, *commands)), *numbers, lost_share(estimate.lost), grid, estimate.share),)


def measured(table: ParameterTable) -> str:
    """Return the name of the parameter that is the measurements' delay."""
    names = sorted({p.name for p in table if p.side == "measurement"})
    if len(names) != 1 or not any(c.kind == "delay" for c in table.columns):
        raise UsageError(
            "the distribution of delays needs one delay of the measurements, and an identified delay; the model's "
            f"delays of measurements: {', '.join(names) or 'none'}",
            hint="leave --links out",
        )
    return names[0]


def find(linearise: Linearise, x: np.ndarray, delay_s: float, again: np.ndarray) -> Delays:
    """Estimate delays, losses, noise and the unknowns of a model together.

    Args:
        x: Shape ``(P,)``: a first estimate of the unknowns.
        delay_s: A first estimate of the mean delay [s].
        again: Shape ``(N,)``, bool: measurements that repeat the previous values: the message was lost, or the robot
            rests, or its device measures more seldom than it is read.
    """
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))

    def estimated(came: np.ndarray, x: np.ndarray, delay_s: float) -> tuple[float, Delays]:
        estimate = _arrived(lambda x, about_s: linearise(x, about_s).rows(came), x, delay_s)
        likelihood = Likelihood(linearise(estimate.x, estimate.mean_s), estimate.delays)
        density = likelihood(np.concatenate([np.zeros(len(x)), estimate.place]))[2]
        # How probable a repeated value is if the message came: the density of its age over that of a new value's age.
        chance = np.exp(np.minimum(density - density[first], 0.0))
        lost = _losses(again, chance)
        share = np.clip(lost.mean(), 0.5 / len(again), 0.5)
        height = np.where(again, np.log(share + (1.0 - share) * chance), np.log(1.0 - share) + density)
        return float(height.sum()), replace(estimate, lost=lost)

    # Estimate from new values alone; then also from repeated values that came, which have longer delays.
    best = estimated(~again, x, delay_s)
    came = ~again | (best[1].lost < _LOST)
    if (came != ~again).any():
        best = estimated(came, best[1].x, best[1].mean_s)
    # Repeated values of a slow device are older than any new value: compare with an estimate in which no message is
    # lost.
    if not came.all():
        best = max(best, estimated(np.ones_like(again), x, delay_s), key=lambda one: one[0])
    return best[1]


def lost_share(lost: np.ndarray) -> Ranged:
    """Return the share of lost messages, with Jeffreys' interval of a binomial proportion."""
    draws = np.random.default_rng(0).beta(lost.sum() + 0.5, len(lost) - lost.sum() + 0.5, 4000)
    low, high = np.quantile(draws, [0.025, 0.975])
    total = float(lost.mean())
    return Ranged(total, float(min(low, total)) if lost.sum() >= 0.5 else 0.0, float(max(high, total)))


def _losses(again: np.ndarray, chance: np.ndarray, rounds: int = 20) -> np.ndarray:
    """Return the probability that each message was lost, ``(N,)``.

    Args:
        chance: Shape ``(N,)``: how probable this repeated value is if the message came.
    """
    share, each = 0.05, np.zeros(len(again))
    for _ in range(rounds):
        each = np.where(again, share / (share + (1.0 - share) * chance), 0.0)
        share = (float(each.sum()) + 0.5) / (len(again) + 1.0)
    return each


class _Watched:
    """The segments of a problem that do not overlap, in the order of time: no measurement counts twice.

    Unknowns are the parameters that are no delays and, where they are fitted, the initial states of the segments.

    Attributes:
        x: Shape ``(P,)``: the unknowns at the estimate.
        delay_s: The measurements' delay at the estimate [s].
        again: Shape ``(N,)``, bool: whether a measurement repeats the previous values.
    """

    def __init__(self, problem: Problem, x: np.ndarray, late: str, delay_s: float) -> None:
        self._problem, self._point, self._late, self.delay_s = problem, x, late, delay_s
        self._segments = _side_by_side(problem)
        self._moved = [i for i, c in enumerate(problem.table.columns) if c.kind != "delay"]
        self._states = 2 * len(problem.channels) if problem.config.initial_state == "free" else 0
        self._counts = problem.ts[self._segments] >= 0.0
        same = np.ones(self._counts.shape, bool)
        same[:, 0] = False
        for column in range(len(problem.fields)):
            rows = problem.measured(column)[self._segments]
            same[:, 1:] &= rows[:, 1:] == rows[:, :-1]
        self.again = same[self._counts]
        self.x = np.concatenate([x[self._moved], np.zeros(self._states * len(self._segments))])

    def linearise(self, unknowns: np.ndarray, about_s: float) -> DelayEvidence:
        """Return the evidence at unknowns ``(P,)``, with the motion simulated for a measurements' delay ``about_s``."""
        problem, table = self._problem, self._problem.table
        size, count = len(self._moved), len(self._segments)
        x, shift = self._point.copy(), np.zeros((count, 2 * len(problem.channels)))
        x[self._moved] = unknowns[:size]
        x = table.within(x)
        if self._states:
            shift = shift + unknowns[size:].reshape(count, -1)
        delays = np.linspace(0.0, table[self._late].high, max(2, round(table[self._late].high / _STEP_S) + 1))
        errors = np.stack([self._errors(x, shift, d, about_s) for d in delays], axis=-1)
        # Derivatives by parameters, and by the initial states of all segments at once.
        J = np.zeros((*errors.shape[:-1], len(unknowns)))
        for k, i in enumerate(self._moved):
            h = problem.config.difference * table.span[i]
            low, high = (table.within(x + s * h * (np.arange(len(x)) == i)) for s in (-1.0, 1.0))
            both = [self._errors(point, shift, about_s, about_s) for point in (low, high)]
            J[..., k] = (both[1] - both[0]) / (high[i] - low[i])
        for k in range(self._states):
            one = 0.03 * (np.arange(self._states) == k)
            slope = (
                self._errors(x, shift + one, about_s, about_s) - self._errors(x, shift - one, about_s, about_s)
            ) / 0.06
            for e in range(count):
                J[e, ..., size + self._states * e + k] = slope[e]
        prior = np.diag(np.concatenate([12.0 / table.span[self._moved] ** 2, np.ones(self._states * count)]))
        return DelayEvidence(delays, errors[self._counts], J[self._counts], prior)

    def _errors(self, x: np.ndarray, shift: np.ndarray, delay_s: float, about_s: float) -> np.ndarray:
        """Return the residuals for a measurements' delay ``delay_s``, with the motion simulated for ``about_s``."""
        problem, count = self._problem, len(self._segments)
        values = {n: np.repeat(v[None], count, axis=0) for n, v in problem.table.decode(x).items()}
        states = []
        for late_s in (about_s, delay_s):
            late = np.full(values[self._late].shape, late_s)
            values = values | {self._late: late}
            states.append(problem.rollouts.starts(values, self._segments, np.zeros_like(shift), problem.data))
        same = (states[0] - states[1]) / problem.rollouts.prior
        return problem.errors(values, self._segments, shift + same)


def _side_by_side(problem: Problem) -> np.ndarray:
    chosen: list[int] = []
    for e in sorted(problem.train, key=lambda e: (problem.recording[e], problem.begins_s[e])):
        same = bool(chosen) and problem.recording[chosen[-1]] == problem.recording[e]
        if not same or problem.begins_s[e] >= problem.begins_s[chosen[-1]] + problem.segment_s - 1e-9:
            chosen.append(int(e))
    if not chosen:
        raise UsageError("there is no fitted segment to find delays in")
    return np.array(chosen)
