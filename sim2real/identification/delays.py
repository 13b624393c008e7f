"""The distribution of the measurements' delay, which no stamp records: mean, 95th percentile, deviation, losses.

The delay of each measurement is hidden, and with it the time of the measured motion. ``hidden`` sums over it: the
shares of all delays are unknowns beside the dynamics, the initial states and the noise. The commands' delay moves the
motion as a whole. Its mean adds to that of the measurements, and a log determines only the sum.
"""

from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.identification import Link, Ranged
from sim2real.errors import UsageError
from sim2real.identification.delay_likelihood import DelayEvidence, Likelihood
from sim2real.identification.hidden_delays import Hidden, Linearise, hidden
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.problem import Problem

_STEP_S = 0.001
"""Distance of the delays at which the motion is predicted [s]."""
_LOST = 0.5
"""Probability of a loss from which on a repeated value counts as lost; below, its delay counts as the others do."""
_WIDTH = 1.96
"""Half the width of an interval, in standard errors."""


@dataclass(frozen=True)
class Delays:
    """Delays and losses of one stream of measurements.

    Attributes:
        hidden: The delays of messages that arrived, and the unknowns of the model.
        lost: Shape ``(N,)``: the probability that each message was lost.
    """

    hidden: Hidden
    lost: np.ndarray

    def ranged(self, held_s: float = 0.0) -> tuple[Ranged, Ranged, Ranged]:
        """Return mean, deviation and 95th percentile with their intervals [s].

        Args:
            held_s: The sum of other delays, which is part of the mean and of the percentile [s].
        """
        (mean, mean_error), (deviation, error) = self.hidden.mean, self.hidden.deviation
        p95, low, high = self.hidden.quantile(0.95, _WIDTH)
        rows = (mean + held_s, _WIDTH * mean_error), (deviation, _WIDTH * error)
        first, second = (Ranged(value, max(value - half, 0.0), value + half) for value, half in rows)
        return first, second, Ranged(p95 + held_s, max(low + held_s, 0.0), high + held_s)


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
    estimate = find(watched.linearise, watched.x, watched.delay_s, watched.again)
    held_s = sum(float(values[n]) for n in commands)
    grid = estimate.hidden.delays + held_s
    numbers = estimate.ranged(held_s)
    return (Link(late, (late, *commands), *numbers, lost_share(estimate.lost), grid, estimate.hidden.share),)


def measured(table: ParameterTable) -> str:
    """Return the name of the measurements' delay."""
    names = sorted({p.name for p in table if p.side == "measurement"})
    if len(names) != 1 or not any(c.parameter.kind == "delay" for c in table.columns):
        raise UsageError(
            f"links need one delay of the measurements and one that is identified, got {', '.join(names) or 'none'}",
            hint="leave --links out",
        )
    return names[0]


def find(linearise: Linearise, x: np.ndarray, delay_s: float, again: np.ndarray) -> Delays:
    """Estimate delays, losses, noise and the unknowns of a model together.

    Args:
        x: Shape ``(P,)``: a first estimate of the unknowns.
        delay_s: A first estimate of the mean delay [s].
        again: Shape ``(N,)``, bool: measurements that repeat the previous values. Either the message was lost, or it
            came and shows the same motion: the robot rests, or its device measures more seldom than it is read.
    """
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))

    def estimated(came: np.ndarray, x: np.ndarray, delay_s: float) -> tuple[float, Delays]:
        estimate = hidden(lambda x, about_s: linearise(x, about_s).rows(came), x, delay_s)
        evidence = linearise(estimate.x, estimate.mean[0])
        density = Likelihood(evidence, estimate.delays, estimate.drift)(estimate.place)[2]
        # How probable a repetition is if the message came: the density of its age over that of the new value's.
        chance = np.exp(np.minimum(density - density[first], 0.0))
        lost = _losses(again, chance)
        share = np.clip(lost.mean(), 0.5 / len(again), 0.5)
        height = np.where(again, np.log(share + (1.0 - share) * chance), np.log(1.0 - share) + density)
        return float(height.sum()), Delays(estimate, lost)

    # Estimate from new values; then, too, from repeated ones that came, which have longer delays.
    best = estimated(~again, x, delay_s)
    came = ~again | (best[1].lost < _LOST)
    if (came != ~again).any():
        best = estimated(came, best[1].hidden.x, best[1].hidden.mean[0])
    # The repetitions of a slow device are older than any new value: compare with an estimate in which all came.
    if not came.all():
        best = max(best, estimated(np.ones_like(again), x, delay_s), key=lambda one: one[0])
    return best[1]


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


class _Watched:
    """The segments of a problem that do not overlap, in the order of time: no measurement counts twice.

    Unknowns are the parameters that are no delays and, where they are fitted, the initial states of the segments.

    Attributes:
        x: Shape ``(P,)``: the unknowns at the estimate.
        delay_s: The measurements' delay there [s].
        again: Shape ``(N,)``, bool: whether a measurement repeats the previous values.
    """

    def __init__(self, problem: Problem, x: np.ndarray, late: str, delay_s: float) -> None:
        self._problem, self._point, self._late, self.delay_s = problem, x, late, delay_s
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
        self.x = np.concatenate([x[self._moved], np.zeros(self._states * len(self._segments))])
        # Stamps are 0 in the middle of each recording.
        recording = problem.recording[self._segments]
        stamps = problem.ts[self._segments] + problem.begins_s[self._segments][:, None]
        for r in np.unique(recording):
            stamps[recording == r] -= stamps[recording == r][self._counts[recording == r]].mean()
        self._stamps = stamps[self._counts]

    def linearise(self, unknowns: np.ndarray, about_s: float) -> DelayEvidence:
        """Return the evidence at unknowns ``(P,)``, in the motion with a delay of the measurements [s]."""
        problem, table = self._problem, self._problem.table
        size, count = len(self._moved), len(self._segments)
        x, shift = self._point.copy(), np.zeros((count, 2 * len(problem.channels)))
        x[self._moved] = unknowns[:size]
        x = table.within(x)
        if self._states:
            shift = shift + unknowns[size:].reshape(count, -1)
        delays = np.linspace(0.0, table[self._late].high, max(2, round(table[self._late].high / _STEP_S) + 1))
        errors = np.stack([self._errors(x, shift, d, about_s) for d in delays], axis=-1)
        # Differences by parameters, and by the initial state of every segment at once.
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
        return DelayEvidence(self._stamps, delays, errors[self._counts], J[self._counts], prior)

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
