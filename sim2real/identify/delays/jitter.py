"""Jitter of commands: by how much the time varies after which a command acts, as the motion shows it.

While a command is late the one before it still acts, so the motion that follows is that of a short push, as large as
the command's change. How late each one was is unknown, but the pushes of all have one variance: it is found by
restricted maximum likelihood, with every push, the parameters and the initial states integrated out (Patterson and
Thompson, Biometrika 58, 1971). What a model does not explain looks like pushes, too, but those know nothing of the
commands' changes: pushes of one size for all commands are a second variance, which takes that part.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, root_scalar

from sim2real.artifacts.estimation.links import Ranged
from sim2real.graph.node import TICKS_PER_S, to_ticks
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Vertex
from sim2real.identify.delays.likelihood import Seen
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Data

_LATER_S, _SHORTEST_S = 0.002, 2e-4
"""By how much a command is moved, to see what that does, and by how much at least where the next one follows [s]."""
_MOST = 600
"""Most commands that are looked at: their deviation is then known to 3 % at best."""
_SMALL = 0.02
"""Smallest change of a command, as a share of the usual change, that is not rounded up to this share."""
_BOUNDS = [(-5.0, 5.0), (np.log(1e-5), np.log(0.05)), (np.log(1e-5), np.log(0.02)), (np.log(1e-5), np.log(10.0))]
"""Of the logarithms of: factor on the noise, deviations of measurements, of commands, of other pushes [s]. Commands
that deviate by a period of 50 Hz are no matter of slopes any more; errors of the model have no such bound."""
_LATE = 2
"""Which of these is looked for."""
_PRECISE, _NEAR = 1e-6, 0.03
"""How precisely the likelihood is maximised, as a share of it, and an interval's ends are found, in their logarithm."""
_DROP = 5.4
"""Drop of twice the log likelihood at the ends of a 95 % interval; see docs/reference/choices.md."""


@dataclass(frozen=True)
class LateCommands:
    """What late commands do in one segment.

    Attributes:
        rows: Shape ``(n,)``: numbers of the segment's measurements among all.
        slopes: Shape ``(n, F, K)``: d residual / d lateness of each command [deviations of the measurement / s].
        sizes: Shape ``(K,)``: how much each command differs from the one before; 1 is usual.
    """

    rows: np.ndarray
    slopes: np.ndarray
    sizes: np.ndarray


def late_commands(problem: Problem, z: np.ndarray, pick: np.ndarray, counts: np.ndarray) -> list[LateCommands]:
    """Simulate segments with one command after the other later than it was sent.

    Args:
        z: Shape ``(P,)``: the estimate.
        pick: Shape ``(E,)``: the segments, recording by recording; the first of them are taken.
        counts: Shape ``(E, C)``, bool: which measurements count.
    """
    width = max(np.shape(leaf)[1] for leaf in jax.tree_util.tree_leaves(problem.given))
    several = max(1, min(len(pick), _MOST // width))
    pick = pick[:several]
    spans = [problem.spans[e] for e in pick for _ in range(width + 1)]  # one more, as it was
    later_s = np.zeros(len(spans))
    copies = problem.recut(spans, problem.segment_s, lambda t: one_later(t, problem.model.given, width, later_s))
    values, residuals = problem.table.decode(jnp.asarray(z, jnp.float32)), problem.residuals

    def every(values: Any, data: Data) -> Any:
        still = jnp.zeros(len(residuals.prior))
        return jax.vmap(lambda e: residuals.residuals(values, e, still, data))(jnp.arange(len(data.recording)))

    found = np.asarray(residuals.program("every", every)(values, copies.data), np.float64)
    rows = found[: len(spans), : counts.shape[1]].reshape(several, width + 1, counts.shape[1], -1)
    by = later_s.reshape(several, width + 1, 1, 1)[:, :-1]
    slopes = np.where(by > 0.0, (rows[:, :-1] - rows[:, -1:]) / np.maximum(by, _SHORTEST_S), 0.0)  # (E, K, C, F)
    sizes, found, begin = _sizes(problem, pick, width), [], 0
    for e, (own, does) in enumerate(zip(counts[:several], slopes, strict=True)):
        felt = np.abs(does[:, own]).max(axis=(1, 2), initial=0.0) > 0.0
        found.append(LateCommands(begin + np.arange(own.sum()), np.moveaxis(does[felt][:, own], 0, -1), sizes[e, felt]))
        begin += int(own.sum())
    return found


def one_later(timeline: Timeline, given: Iterable[str], width: int, later_s: np.ndarray) -> Timeline:
    """Return copies of segments, ``width + 1`` of each, of which all but the last have a command that is later.

    Args:
        given: Nodes that send commands.
        later_s: Shape ``(copies,)``: filled with by how much [s]: less where the next one follows soon, 0 in bursts.
    """
    moved, copies = dict(timeline.vertices), np.arange(len(later_s))
    own, ticks = copies % (width + 1), np.full(len(copies), to_ticks(_LATER_S))
    for name in given:
        v = moved[name]
        last = v.start.shape[1] - 1
        here, after = np.minimum(own, last), np.minimum(own + 1, last)
        room = np.where(own + 1 < v.count, v.start[copies, after] - v.end[copies, here], ticks)
        ticks = np.where(own < np.minimum(v.count, width), np.minimum(ticks, room), 0)
    ticks = np.where(ticks < to_ticks(_SHORTEST_S), 0, ticks)
    for name in given:
        v, shift = moved[name], np.zeros_like(moved[name].start)
        shift[copies, np.minimum(own, v.start.shape[1] - 1)] = ticks
        moved[name] = Vertex(v.start + shift, v.end + shift, v.count)
    later_s[:] = ticks / TICKS_PER_S
    return Timeline(moved, timeline.edges)


def _sizes(problem: Problem, pick: np.ndarray, width: int) -> np.ndarray:
    """Return how much each command differs from the one before ``(E, width)``, 1 on average."""
    total = np.zeros((len(pick), width))
    for leaf in jax.tree_util.tree_leaves(problem.given):
        rows = np.asarray(leaf, np.float64)[pick].reshape(len(pick), np.shape(leaf)[1], -1)
        change = np.linalg.norm(np.diff(rows, axis=1, prepend=rows[:, :1]), axis=2) / max(float(rows.std()), 1e-12)
        total[:, : change.shape[1]] += change
    return total / max(float(total.mean()), 1e-12)


def deviation(
    seen: Seen, delays: np.ndarray, deviation_s: float, noise: np.ndarray, late: Sequence[LateCommands]
) -> Ranged:
    """Return the standard deviation of the commands' delays with its 95 % interval [s]; None where it is not known.

    Args:
        seen: What is seen, at the estimate.
        delays: Shape ``(N,)``: the measurements' delays, as far as they are known [s].
        deviation_s: About the deviation of their delays [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """
    late = [own for own in late if own.slopes.size]
    if not late:
        return Ranged(None, None, None)
    likelihood = Variances(seen, delays, noise, late)
    others = [i for i in range(len(_BOUNDS)) if i != _LATE]
    low, high = _BOUNDS[_LATE]
    both = ((1e-4, 1e-4), (2e-3, 1e-4), (1e-4, 0.1))  # errors of a model may be large, or there may be none
    starts = [np.log([1.0, max(deviation_s, 1e-4), late_s, other_s]) for late_s, other_s in both]
    climb = partial(minimize, jac=True, method="L-BFGS-B", options={"ftol": _PRECISE})
    ends = [climb(likelihood, s, bounds=_BOUNDS) for s in starts]
    best = min(ends, key=lambda r: r.fun)
    top = float(best.x[_LATE])

    @cache
    def lower(late_s: float) -> float:
        """Return by how much the likelihood is lower there than at an interval's ends; negative within it."""

        def at(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = likelihood(np.insert(x, _LATE, late_s))
            return value, slope[others]

        found = climb(at, best.x[others], bounds=[_BOUNDS[i] for i in others])
        return float(found.fun - best.fun) - _DROP

    begin = root_scalar(lower, bracket=(low, top), xtol=_NEAR).root if top > low and lower(low) > 0.0 else low
    if top >= high or lower(high) <= 0.0:
        return Ranged(None, None, None)
    end = root_scalar(lower, bracket=(top, high), xtol=_NEAR).root
    value, least, most = (0.0 if p <= low else float(np.exp(p)) for p in (top, begin, end))
    return Ranged(value, least, most)


class Variances:
    """The restricted likelihood of residuals with pushes, as a function of four deviations.

    Args:
        seen: What is seen, at the estimate.
        delays: Shape ``(N,)``: the measurements' delays, as far as they are known [s].
        noise: Shape ``(F,)``: deviation of the noise, in deviations of the measurement.
    """

    def __init__(self, seen: Seen, delays: np.ndarray, noise: np.ndarray, late: Sequence[LateCommands]) -> None:
        errors, slopes = seen.at(delays[:, None])
        self._prior, self._parts = seen.prior, []
        for own in late:
            pushed = own.slopes.reshape(-1, own.slopes.shape[2])
            self._parts.append((
                errors[own.rows, :, 0].reshape(-1),
                seen.jacobian[own.rows].reshape(-1, seen.jacobian.shape[2]),
                np.tile(noise**2, len(own.rows)),
                slopes[own.rows, :, 0].reshape(-1) ** 2,
                pushed,
                pushed / np.maximum(own.sizes, _SMALL),
            ))  # fmt: skip

    def __call__(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return twice the negative logarithm of the likelihood, up to a constant, and its gradient ``(4,)``.

        Args:
            p: Shape ``(4,)``: logarithms of a factor on the noise, and of the deviations of the measurements' delays,
                of the commands' delays, and of pushes that know nothing of the commands [s of a usual one's lateness].
        """
        size = np.exp(2 * np.asarray(p))
        total, information, pull, kept = 0.0, self._prior.copy(), np.zeros(len(self._prior)), []
        for error, J, own, slope, *pushed in self._parts:
            spread = sum(s * B @ B.T for s, B in zip(size[2:], pushed, strict=True))
            spread = spread + np.diag(size[0] * own + size[1] * slope)
            factor = cho_factor(spread, lower=True)
            inverse = cho_solve(factor, np.eye(len(error)))
            weighed, off = inverse @ J, inverse @ error
            total += 2 * float(np.log(np.diag(factor[0])).sum()) + float(error @ off)
            information += J.T @ weighed
            pull += J.T @ off
            kept.append((inverse, weighed, off))
        known = np.linalg.inv(information)
        x, gradient = known @ pull, np.zeros(4)
        for (_, _, own, slope, *pushed), (inverse, weighed, off) in zip(self._parts, kept, strict=True):
            left = off - weighed @ x
            plain = np.diag(inverse) - ((weighed @ known) * weighed).sum(axis=1) - left**2
            gradient[:2] += plain @ own, plain @ slope
            for i, B in enumerate(pushed):
                seen = weighed.T @ B
                gradient[2 + i] += (B * (inverse @ B)).sum() - (seen * (known @ seen)).sum() - ((left @ B) ** 2).sum()
        return total + float(np.linalg.slogdet(information)[1] - pull @ x), 2 * size * gradient
