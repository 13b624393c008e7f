"""Jitter of commands: the variation of their delay, estimated from the motion.

While a command is late, the previous one still acts, so the motion changes as by a short push in proportion to the
command's change. The lateness of each command is unknown, but all pushes have one variance. Restricted maximum
likelihood estimates it, with every push, the parameters and the initial states integrated out (Patterson and Thompson,
Biometrika 58, 1971). Errors of the model look like pushes, too, but do not depend on the commands' changes: pushes of
one size for all commands have a second variance, which absorbs them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, root_scalar

from sim2real.artifacts.identification import Ranged
from sim2real.graph.node import TICKS_PER_S, to_ticks
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Vertex
from sim2real.identify.delays.likelihood import DelayEvidence
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Data
from sim2real.types import PyTree

_LATER_S, _SHORTEST_S = 0.002, 2e-4
"""Delay that is added to a command in simulation, and the least one if the next command follows soon [s]."""
_MOST = 600
"""Largest number of commands that are simulated: their deviation then has a standard error of at least 3 %."""
_SMALL = 0.02
"""Smallest change of a command, as a share of the usual change, that is not rounded up to this share."""
_BOUNDS = [(-5.0, 5.0), (np.log(1e-5), np.log(0.05)), (np.log(1e-5), np.log(0.02)), (np.log(1e-5), np.log(10.0))]
"""Bounds of the logarithms of: factor on the noise, deviations of measurements, of commands, of other pushes [s]. A
linear model does not hold for commands that deviate by a period of 50 Hz; errors of the model have no such bound."""
_LATE = 2
"""Index of the deviation that is estimated."""
_PRECISE, _NEAR = 1e-6, 0.03
"""Tolerances: of the maximum of the likelihood, as a share of it; of an interval's ends, in their logarithm."""
_DROP = 5.4
"""Drop of twice the log likelihood at the ends of a 95 % interval; see docs/reference/choices.md."""


@dataclass(frozen=True)
class LateCommands:
    """The effect of late commands in one segment.

    Attributes:
        rows: Shape ``(n,)``: numbers of the segment's measurements among all.
        slopes: Shape ``(n, F, K)``: d residual / d lateness of each command [deviations of the measurement / s].
        sizes: Shape ``(K,)``: difference of each command from the previous one, relative to the mean difference.
    """

    rows: np.ndarray
    slopes: np.ndarray
    sizes: np.ndarray


def late_commands(problem: Problem, z: np.ndarray, pick: np.ndarray, counts: np.ndarray) -> list[LateCommands]:
    """Simulate segments with each command in turn later than it was sent.

    Args:
        z: Shape ``(P,)``: the estimate.
        pick: Shape ``(E,)``: the segments, sorted by recording; the first ones are used.
        counts: Shape ``(E, C)``, bool: which measurements count.
    """
    # Copy each segment once for each of its commands.
    width = max(np.shape(leaf)[1] for leaf in jax.tree_util.tree_leaves(problem.messages))
    several = max(1, min(len(pick), _MOST // width))
    pick = pick[:several]
    spans = [problem.spans[e] for e in pick for _ in range(width + 1)]  # and one copy without a change
    later_s = np.zeros(len(spans))
    copies = problem.recut(spans, problem.segment_s, lambda t: one_later(t, problem.model.given, width, later_s))

    # Simulate all copies.
    values, residuals = problem.table.decode(jnp.asarray(z, jnp.float32)), problem.residuals

    def every(values: Any, data: Data) -> PyTree:
        still = jnp.zeros(len(residuals.prior))
        return jax.vmap(lambda e: residuals.residuals(values, e, still, data))(jnp.arange(len(data.recording)))

    predicted = np.asarray(residuals.program("every", every)(values, copies.data), np.float64)
    rows = predicted[: len(spans), : counts.shape[1]].reshape(several, width + 1, counts.shape[1], -1)

    # The slope of the residuals by each delay, for commands with an effect.
    by = later_s.reshape(several, width + 1, 1, 1)[:, :-1]
    slopes = np.where(by > 0.0, (rows[:, :-1] - rows[:, -1:]) / np.maximum(by, _SHORTEST_S), 0.0)  # (E, K, C, F)
    sizes, segments, begin = _sizes(problem, pick, width), [], 0
    for e, (counted, does) in enumerate(zip(counts[:several], slopes, strict=True)):
        felt = np.abs(does[:, counted]).max(axis=(1, 2), initial=0.0) > 0.0
        segments.append(
            LateCommands(begin + np.arange(counted.sum()), np.moveaxis(does[felt][:, counted], 0, -1), sizes[e, felt])
        )
        begin += int(counted.sum())
    return segments


def one_later(timeline: Timeline, senders: Iterable[str], width: int, later_s: np.ndarray) -> Timeline:
    """Return copies of segments, ``width + 1`` of each; all but the last have one later command.

    Args:
        senders: Nodes that send commands.
        later_s: Shape ``(copies,)``: receives the added delay [s]: less if the next command follows soon, 0 in bursts.
    """
    # The largest delay at which a command still comes before the next.
    moved, copies = dict(timeline.vertices), np.arange(len(later_s))
    which, ticks = copies % (width + 1), np.full(len(copies), to_ticks(_LATER_S))
    for name in senders:
        v = moved[name]
        last = v.start.shape[1] - 1
        here, after = np.minimum(which, last), np.minimum(which + 1, last)
        room = np.where(which + 1 < v.count, v.start[copies, after] - v.end[copies, here], ticks)
        ticks = np.where(which < np.minimum(v.count, width), np.minimum(ticks, room), 0)

    # Move one command in each copy.
    ticks = np.where(ticks < to_ticks(_SHORTEST_S), 0, ticks)
    for name in senders:
        v, shift = moved[name], np.zeros_like(moved[name].start)
        shift[copies, np.minimum(which, v.start.shape[1] - 1)] = ticks
        moved[name] = Vertex(v.start + shift, v.end + shift, v.count)
    later_s[:] = ticks / TICKS_PER_S
    return Timeline(moved, timeline.edges)


def _sizes(problem: Problem, pick: np.ndarray, width: int) -> np.ndarray:
    """Return the difference of each command from the previous one, ``(E, width)``, 1 on average."""
    total = np.zeros((len(pick), width))
    for leaf in jax.tree_util.tree_leaves(problem.messages):
        rows = np.asarray(leaf, np.float64)[pick].reshape(len(pick), np.shape(leaf)[1], -1)
        change = np.linalg.norm(np.diff(rows, axis=1, prepend=rows[:, :1]), axis=2) / max(float(rows.std()), 1e-12)
        total[:, : change.shape[1]] += change
    return total / max(float(total.mean()), 1e-12)


def deviation(
    evidence: DelayEvidence, delays: np.ndarray, deviation_s: float, noise: np.ndarray, late: Sequence[LateCommands]
) -> Ranged:
    """Return the standard deviation of the commands' delays with its 95 % interval [s]; None if it is not determined.

    Args:
        evidence: The measurements, linearised at the estimate.
        delays: Shape ``(N,)``: the measurements' delays, estimated [s].
        deviation_s: About the deviation of their delays [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """
    late = [segment for segment in late if segment.slopes.size]
    if not late:
        return Ranged(None, None, None)

    # Maximise from two starts.
    likelihood = Variances(evidence, delays, noise, late)
    others = [i for i in range(len(_BOUNDS)) if i != _LATE]
    low, high = _BOUNDS[_LATE]
    both = ((1e-4, 1e-4), (2e-3, 1e-4), (1e-4, 0.1))  # with small and with large errors of the model
    starts = [np.log([1.0, max(deviation_s, 1e-4), late_s, other_s]) for late_s, other_s in both]
    climb = partial(minimize, jac=True, method="L-BFGS-B", options={"ftol": _PRECISE})
    ends = [climb(likelihood, s, bounds=_BOUNDS) for s in starts]
    best = min(ends, key=lambda r: r.fun)
    top = float(best.x[_LATE])

    @cache
    def lower(late_s: float) -> float:
        """Return the drop of the likelihood beyond that of an interval's end; negative within the interval."""

        def at(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = likelihood(np.insert(x, _LATE, late_s))
            return value, slope[others]

        best_there = climb(at, best.x[others], bounds=[_BOUNDS[i] for i in others])
        return float(best_there.fun - best.fun) - _DROP

    # The ends of the interval.
    begin = root_scalar(lower, bracket=(low, top), xtol=_NEAR).root if top > low and lower(low) > 0.0 else low
    if top >= high or lower(high) <= 0.0:
        return Ranged(None, None, None)
    end = root_scalar(lower, bracket=(top, high), xtol=_NEAR).root
    value, least, most = (0.0 if p <= low else float(np.exp(p)) for p in (top, begin, end))
    return Ranged(value, least, most)


class Variances:
    """The restricted likelihood of residuals with pushes, as a function of four deviations.

    Args:
        evidence: The measurements, linearised at the estimate.
        delays: Shape ``(N,)``: the measurements' delays, estimated [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """

    def __init__(
        self, evidence: DelayEvidence, delays: np.ndarray, noise: np.ndarray, late: Sequence[LateCommands]
    ) -> None:
        errors, slopes = evidence.at(delays[:, None])
        self._prior, self._parts = evidence.prior, []
        for segment in late:
            pushed = segment.slopes.reshape(-1, segment.slopes.shape[2])
            self._parts.append((
                errors[segment.rows, :, 0].reshape(-1),
                evidence.jacobian[segment.rows].reshape(-1, evidence.jacobian.shape[2]),
                np.tile(noise**2, len(segment.rows)),
                slopes[segment.rows, :, 0].reshape(-1) ** 2,
                pushed,
                pushed / np.maximum(segment.sizes, _SMALL),
            ))  # fmt: skip

    def __call__(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return twice the negative logarithm of the likelihood, up to a constant, and its gradient ``(4,)``.

        Args:
            p: Shape ``(4,)``: logarithms of a factor on the noise, and of the deviations of the measurements' delays,
                of the commands' delays, and of pushes that do not depend on commands [s of the mean command's
                lateness].
        """
        size = np.exp(2 * np.asarray(p))
        total, information, pull, solved = 0.0, self._prior.copy(), np.zeros(len(self._prior)), []
        for error, J, noise, slope, *pushed in self._parts:
            # The covariance of a segment's residuals, and its share of the information.
            spread = sum(s * B @ B.T for s, B in zip(size[2:], pushed, strict=True))
            spread = spread + np.diag(size[0] * noise + size[1] * slope)
            factor = cho_factor(spread, lower=True)
            inverse = cho_solve(factor, np.eye(len(error)))
            weighed, off = inverse @ J, inverse @ error
            total += 2 * float(np.log(np.diag(factor[0])).sum()) + float(error @ off)
            information += J.T @ weighed
            pull += J.T @ off
            solved.append((inverse, weighed, off))

        # The gradient, with parameters and initial states integrated out.
        covariance = np.linalg.inv(information)
        x, gradient = covariance @ pull, np.zeros(4)
        for (_, _, noise, slope, *pushed), (inverse, weighed, off) in zip(self._parts, solved, strict=True):
            left = off - weighed @ x
            plain = np.diag(inverse) - ((weighed @ covariance) * weighed).sum(axis=1) - left**2
            gradient[:2] += plain @ noise, plain @ slope
            for i, B in enumerate(pushed):
                lever = weighed.T @ B
                gradient[2 + i] += (
                    (B * (inverse @ B)).sum() - (lever * (covariance @ lever)).sum() - ((left @ B) ** 2).sum()
                )
        return total + float(np.linalg.slogdet(information)[1] - pull @ x), 2 * size * gradient
