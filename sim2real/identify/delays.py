"""The distribution of the measurements' delay, which no stamp records: mean, 95th percentile, deviation, losses.

A measurement with stamp t shows the motion at t - d. The model predicts the motion; where it is fast, a measurement
determines d well. The likelihood of a measurement is a sum over a grid of delays: the share of each delay times the
density of the measurement at that delay. Expectation and maximisation find the shares, together with the parameters of
the dynamics, the initial states and the noise. The commands' delay moves the motion as a whole: its mean adds to that
of the measurements, and a log determines only the sum.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import Link, Ranged
from sim2real.errors import UsageError
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem

_STEP_S = 0.001
"""Distance of the delays at which the motion is predicted [s]."""
_FINE = 4
"""Points of the grid of shares between two of these."""
_ROUNDS, _STEPS = 3, 60
"""Linearisations of the model, and steps of expectation and maximisation for each."""
_FLOOR = 1e-12
"""Least share of a grid point in the likelihood, so that a single measurement cannot make it infinite."""
_LOST = 0.5
"""Probability of a loss from which on a repeated value counts as lost; below, its delay counts as the others do."""
_DRAWS = 100
"""Resampled recordings from which intervals are taken."""
_BLOCKS = 20
"""Blocks of successive messages of which a resampled recording consists: their delays depend on each other."""
_WIDTH = 1.96
"""Half the width of an interval, in standard errors."""


@dataclass(frozen=True)
class Evidence:
    """Agreement of measurements with a model's predictions, for every possible delay.

    Attributes:
        delays: Shape ``(G,)``: delays at equal distances [s].
        errors: Shape ``(N, F, G)``: prediction minus measurement at each delay, in deviations of the measurement.
        jacobian: Shape ``(N, F, P)``: d error / d unknown, near the mean delay.
        prior: Shape ``(P, P)``: precision of the unknowns before the log.
    """

    delays: np.ndarray
    errors: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray

    def rows(self, which: np.ndarray) -> "Evidence":
        """Return some of the measurements, ``(N,)`` bool."""
        return replace(self, errors=self.errors[which], jacobian=self.jacobian[which])

    def finer(self, factor: int) -> "Evidence":
        """Return the errors on a finer grid of delays, interpolated linearly."""
        delays = np.linspace(self.delays[0], self.delays[-1], factor * (len(self.delays) - 1) + 1)
        place = np.minimum((np.arange(len(delays)) / factor).astype(int), len(self.delays) - 2)
        share = np.arange(len(delays)) / factor - place
        errors = self.errors[..., place] * (1.0 - share) + self.errors[..., place + 1] * share
        return replace(self, delays=delays, errors=errors)


@dataclass(frozen=True)
class Delays:
    """The estimated distribution of the delays of messages.

    Attributes:
        move: Shape ``(P,)``: the change of the unknowns.
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
        delays: Shape ``(G,)``: a grid of delays [s].
        share: Shape ``(G,)``: share of the messages that have each.
        mean_error: Standard error of the mean by least squares, together with the unknowns [s].
        lost: Shape ``(N,)``: the probability that each message was lost.
    """

    move: np.ndarray
    noise: np.ndarray
    delays: np.ndarray
    share: np.ndarray
    mean_error: float
    lost: np.ndarray

    @property
    def mean(self) -> float:
        """The mean delay [s]."""
        return float(self.share @ self.delays)

    @property
    def numbers(self) -> np.ndarray:
        """Mean, deviation and 95th percentile [s]."""
        return _numbers(self.delays, self.share)


def _numbers(delays: np.ndarray, share: np.ndarray) -> np.ndarray:
    mean = float(share @ delays)
    below = np.cumsum(share) - 0.5 * share
    return np.array([mean, np.sqrt(share @ (delays - mean) ** 2), np.interp(0.95, below, delays)])


def links(problem: Problem, x: np.ndarray) -> tuple[Link, ...]:
    """Return the link of a problem's measurements.

    Args:
        x: Shape ``(P,)``: the estimate of a fit, from which dynamics and delays are estimated together.

    Raises:
        UsageError: When no delay of the measurements is identified.
    """
    late, table = measured(problem.table), problem.table
    # Give both sides of the world half of the delay, so that those of single measurements can be shorter or longer.
    values = {n: np.asarray(v, np.float64) for n, v in table.decode(x).items()}
    commands = [c.parameter.name for c in table.columns if c.parameter.side == "command"]
    half_s = (float(values[late]) + sum(float(values[n]) for n in commands)) / 2.0
    if commands and not table[late].free:
        values = values | {late: np.float64(half_s), commands[0]: np.float64(half_s)}
    watched = _Watched(problem, table.encode(values), late, float(values[late]))
    estimate, low, high = find(watched.evidence, watched.again)
    held_s = sum(float(values[n]) for n in commands)
    mean, deviation, p95 = (
        Ranged(float(v + held), float(max(a + held, 0.0)), float(b + held))
        for v, a, b, held in zip(estimate.numbers, low, high, (held_s, 0.0, held_s), strict=True)
    )
    return (
        Link(late, (late, *commands), mean, deviation, p95, lost_share(estimate.lost), estimate.delays + held_s,
             estimate.share),
    )  # fmt: skip


def measured(table: ParameterTable) -> str:
    """Return the name of the measurements' delay."""
    names = sorted({p.name for p in table if p.side == "measurement"})
    if len(names) != 1 or not any(c.parameter.kind == "delay" for c in table.columns):
        raise UsageError(
            f"links need one delay of the measurements and one that is identified, got {', '.join(names) or 'none'}",
            hint="leave --links out",
        )
    return names[0]


def find(
    evidence: Callable[[np.ndarray, float | None], Evidence], again: np.ndarray
) -> tuple[Delays, np.ndarray, np.ndarray]:
    """Estimate delays, losses, noise and the unknowns of a model together.

    Args:
        evidence: The model linearised at a change of its unknowns, and about a mean delay [s]; None: where it began.
        again: Shape ``(N,)``, bool: measurements that repeat the previous values. Either the message was lost, or it
            came and shows the same motion: the robot rests, or its device measures more seldom than it is read.

    Returns:
        The distribution, and the ends of the intervals of its mean, deviation and 95th percentile ``(3,)`` [s].
    """
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))
    move, about_s, came = np.zeros(0), None, ~again
    at = found = None
    for _ in range(_ROUNDS):
        at = evidence(move, about_s).finer(_FINE)
        found = _maximised(at.rows(came), np.ones(int(came.sum())))
        # How probable a repetition is if the message came: the density of its age over that of the new value's.
        density = _density(at, found)
        chance = np.exp(np.minimum(density - density[first], 0.0))
        found = replace(found, lost=_losses(again, chance))
        came = ~again | (found.lost < _LOST)
        move, about_s = (found.move if not move.size else move + found.move), found.mean
    if at is None or found is None:
        raise RuntimeError("no round was made")
    # Resample blocks of messages, with the unknowns held, and add the error that the unknowns make.
    rng, kept = np.random.default_rng(0), at.rows(came)
    block = np.arange(int(came.sum())) * _BLOCKS // max(int(came.sum()), 1)
    height, drawn = _heights(kept, found), list[np.ndarray]()
    for _ in range(_DRAWS):
        weight = rng.multinomial(_BLOCKS, np.full(_BLOCKS, 1 / _BLOCKS))[block]
        drawn.append(_numbers(at.delays, _shares(height, weight, found.share)))
    spread = np.std(drawn, axis=0)
    whole = np.hypot(spread, [found.mean_error, 0.0, found.mean_error])
    half = np.array([0.0, 0.0, 0.5 * (at.delays[1] - at.delays[0])])
    return found, found.numbers - _WIDTH * whole - half, found.numbers + _WIDTH * whole + half


def lost_share(lost: np.ndarray) -> Ranged:
    """Return the share of lost messages; the interval is that of a binomial with a flat prior (Jeffreys)."""
    draws = np.random.default_rng(0).beta(lost.sum() + 0.5, len(lost) - lost.sum() + 0.5, 4000)
    low, high = np.quantile(draws, [0.025, 0.975])
    total = float(lost.mean())
    return Ranged(total, float(min(low, total)) if lost.sum() >= 0.5 else 0.0, float(max(high, total)))


def _losses(again: np.ndarray, chance: np.ndarray, rounds: int = 20) -> np.ndarray:
    """Return the probability that each message was lost, ``(N,)``.

    Args:
        chance: Shape ``(N,)``: how probable a repeated value is for a message that came.
    """
    share, each = 0.05, np.zeros(len(again))
    for _ in range(rounds):
        each = np.where(again, share / (share + (1.0 - share) * chance), 0.0)
        share = (float(each.sum()) + 0.5) / (len(again) + 1.0)
    return each


def _maximised(at: Evidence, weight: np.ndarray) -> Delays:
    """Return the shares of the delays, the noise and the unknowns, by expectation and maximisation."""
    count, fields, size = at.errors.shape
    share, noise, move = np.full(size, 1.0 / size), np.ones(fields), np.zeros(at.jacobian.shape[2])
    likely = np.zeros((count, size))
    for step in range(_STEPS):
        # Expectation: the probability of each delay for each measurement.
        off = (at.errors + (at.jacobian @ move)[:, :, None]) / noise[None, :, None]
        height = -0.5 * (off**2).sum(axis=1) + np.log(share + _FLOOR)
        likely = np.exp(height - height.max(axis=1, keepdims=True))
        likely /= likely.sum(axis=1, keepdims=True)
        # Maximisation: shares, unknowns and noise. At first the shares are wide, so that no delay is excluded.
        share = weight @ likely / weight.sum()
        if step < _STEPS // 4:
            share = np.convolve(share, np.ones(5) / 5, "same")
            share /= share.sum()
        J = (at.jacobian / noise[None, :, None]).reshape(-1, len(move))
        error = (np.einsum("nk,nfk->nf", likely, at.errors) / noise).reshape(-1)
        move = -np.linalg.solve(J.T @ J + at.prior + 1e-12 * np.eye(len(move)), J.T @ error)
        off = at.errors + (at.jacobian @ move)[:, :, None]
        noise = np.sqrt(np.einsum("nk,nfk->f", likely, off**2) / count)
    return Delays(move, noise, at.delays, share, _mean_error(at, share, noise), np.zeros(0))


def _heights(at: Evidence, found: Delays) -> np.ndarray:
    """Return the log density of each measurement at each delay, ``(N, G)``."""
    off = (at.errors + (at.jacobian @ found.move)[:, :, None]) / found.noise[None, :, None]
    return -0.5 * (off**2).sum(axis=1)


def _density(at: Evidence, found: Delays) -> np.ndarray:
    """Return the log density of each measurement, ``(N,)``, up to a constant."""
    height = _heights(at, found) + np.log(found.share + _FLOOR)
    top = height.max(axis=1)
    return top + np.log(np.exp(height - top[:, None]).sum(axis=1))


def _shares(height: np.ndarray, weight: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the shares of the delays of weighted measurements with the unknowns held."""
    likelihood = np.exp(height - height.max(axis=1, keepdims=True))
    for _ in range(_STEPS // 3):
        likely = likelihood * (share + _FLOOR)
        share = weight @ (likely / likely.sum(axis=1, keepdims=True)) / weight.sum()
    return share


def _mean_error(at: Evidence, share: np.ndarray, noise: np.ndarray) -> float:
    """Return the standard error of the mean delay by least squares, which assume no shape of the distribution [s].

    Delays of successive messages depend on each other, so products of gradients of messages up to a few steps apart are
    added (Newey and West, Econometrica 55, 1987).
    """
    mean, deviation, _ = _numbers(at.delays, share)
    place = int(np.clip(np.searchsorted(at.delays, mean), 1, len(at.delays) - 1))
    slope = (at.errors[..., place] - at.errors[..., place - 1]) / (at.delays[1] - at.delays[0])
    weight = 1.0 / np.sqrt(noise**2 + (slope * deviation) ** 2)
    columns = np.concatenate([at.jacobian, slope[..., None]], axis=2) * weight[..., None]
    prior = np.pad(at.prior, (0, 1)) + 1e-12 * np.eye(columns.shape[2])
    inverse = np.linalg.inv(np.einsum("nfp,nfq->pq", columns, columns) + prior)
    rest = at.errors[..., place] * weight
    rest = rest - columns @ (inverse @ np.einsum("nfp,nf->p", columns, rest))
    gradient = np.einsum("nfp,nf->np", columns, rest)
    lags, between = round(len(gradient) ** (1 / 3)), gradient.T @ gradient
    for lag in range(1, lags + 1):
        product = gradient[lag:].T @ gradient[:-lag]
        between += (1 - lag / (lags + 1)) * (product + product.T)
    return float(np.sqrt(max((inverse @ between @ inverse)[-1, -1], 0.0)))


class _Watched:
    """The segments of a problem that do not overlap, in the order of time: no measurement counts twice.

    Unknowns are the parameters that are no delays and, where they are fitted, the initial states of the segments.

    Attributes:
        again: Shape ``(N,)``, bool: whether a measurement repeats the previous values.
    """

    def __init__(self, problem: Problem, x: np.ndarray, late: str, delay_s: float) -> None:
        self._problem, self._x, self._late, self._delay_s = problem, x, late, delay_s
        self._segments = _side_by_side(problem)
        self._moved = [i for i, c in enumerate(problem.table.columns) if c.parameter.kind != "delay"]
        self._states = 2 * len(problem.channels) if problem.config.initial_state == "free" else 0
        self._counts = problem.ts[self._segments] >= 0.0
        same = np.ones(self._counts.shape, bool)
        same[:, 0] = False
        for column in range(len(problem.fields)):
            rows = problem.measured(column)[self._segments]
            same[:, 1:] &= rows[:, 1:] == rows[:, :-1]
        self.again = same[self._counts]

    def evidence(self, move: np.ndarray, about_s: float | None) -> Evidence:
        """Return the evidence at a change of the unknowns ``(P,)``."""
        problem, table = self._problem, self._problem.table
        about_s = self._delay_s if about_s is None else about_s
        size, count = len(self._moved), len(self._segments)
        move = np.zeros(size + self._states * count) if not move.size else move
        x, shift = self._x.copy(), np.zeros((count, 2 * len(problem.channels)))
        x[self._moved] += move[:size]
        if self._states:
            shift = shift + move[size:].reshape(count, -1)
        delays = np.linspace(0.0, table[self._late].high, max(2, round(table[self._late].high / _STEP_S) + 1))
        errors = np.stack([self._errors(x, shift, d, about_s) for d in delays], axis=-1)
        # Differences by parameters, and by the initial state of every segment at once.
        J = np.zeros((*errors.shape[:-1], len(move)))
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
        return Evidence(delays, errors[self._counts], J[self._counts], prior)

    def _errors(self, x: np.ndarray, shift: np.ndarray, delay_s: float, about_s: float) -> np.ndarray:
        """Return the residuals of the segments with a delay of the measurements, in the motion with ``about_s``."""
        problem, count = self._problem, len(self._segments)
        values = {n: np.repeat(v[None], count, axis=0) for n, v in problem.table.decode(x).items()}
        states = []
        for late_s in (about_s, delay_s):
            late = np.full(values[self._late].shape, late_s)
            values = values | {self._late: late}
            states.append(problem.rollouts.starts(values, self._segments, np.zeros_like(shift), problem.data))
        same = (states[0] - states[1]) / problem.rollouts.prior
        return problem.residuals.errors(values, self._segments, shift + same)


def _side_by_side(problem: Problem) -> np.ndarray:
    chosen: list[int] = []
    for e in sorted(problem.train, key=lambda e: (problem.recording[e], problem.begins_s[e])):
        same = bool(chosen) and problem.recording[chosen[-1]] == problem.recording[e]
        if not same or problem.begins_s[e] >= problem.begins_s[chosen[-1]] + problem.segment_s - 1e-9:
            chosen.append(int(e))
    if not chosen:
        raise UsageError("there is no fitted segment to find delays in")
    return np.array(chosen)
