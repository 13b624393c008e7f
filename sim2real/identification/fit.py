"""From recordings to an estimate: search on windows, descend by least squares, descend on longer segments.

Two points are compared by their losses after the initial states were fitted at each of them.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import MOST_OF_FIT, Part, Problem, few_of, of_recordings, robust, thinned
from sim2real.identification.search import SearchResult, search
from sim2real.identification.segments import Span
from sim2real.identification.uncertainty import (
    Uncertainty,
    deviation,
    from_linearised,
    loss_variance,
    root_of_inverse,
)

_ROUGHLY = 0.05
"""Relative gain of the loss in a step below which a descent ends that only looks for a start."""
_COARSE = 1e-3
"""Relative gain of the loss below which the rough descent from each start ends."""
ROUGH = 1e-2
"""Relative gain of the loss below which the descent of a set of terms ends: sets are compared by percents."""
_NEARLY, _APART = 1.5, 0.02
"""Largest ratio of two losses after a rough descent for which both starts are followed, and the smallest distance of
their ends, as a share of the range between the bounds.
"""
_ROUNDS, _BACK = 4, 4
"""Most rounds of a descent, and how often a failed round goes half the way back to its start."""
_NEAR = 1e-5
"""Relative change of the point below which a descent ends."""
_LEFT = 0.1
"""A descent has converged if the next Gauss-Newton step is shorter than this [standard errors]."""
_POLLED, _AWAY, _BETTER = 12, 0.5, 1e-3
"""If a descent ended without convergence: number of points that are tried around its end, their distance [standard
errors], and by which share their loss must be lower. Where friction sticks, derivatives do not describe them.
"""
_TRIES = 3
_SHIFTS = (-0.5, -0.25, 0.25, 0.5)
"""Changes of the delay with which further descents begin [periods of the commands]. At 50 Hz an arm's loss had minima
at 15, 21 and 28 ms: half a period alone leapt from the last to the first.
"""
_DAMPING, _EASIER, _HARDER, _FAILED = 1e-3, 0.2, 10.0, 5
"""First damping of a round, as a share of the curvature; its factors after a good and after a failed step; number of
failed steps in a row that ends a round.
"""
_SHORT = 8
"""Most steps of a round with a limited number of Jacobians."""
_COLUMNS = 16384
"""Residuals whose derivatives are multiplied at a time: a scaled copy of all of them took a tenth of a fit."""
_AS_PREDICTED = 0.25
"""A small gain ends a round only if the step gained at least this share of the prediction."""
OnStep = Callable[[float, np.ndarray], None]
"""Called with the best loss and point ``(P,)`` so far, after every evaluation."""
OnProgress = Callable[[str, float, float, np.ndarray], None]
"""Called with the phase (``search`` or ``refine``), the share of it done since the last call, and the
best loss and point so far."""


@dataclass(frozen=True)
class Refined:
    """Result of a refinement.

    Attributes:
        x: Shape ``(P,)``: the best point.
        left: Largest move of a parameter in the next Gauss-Newton step [standard errors].
        converged: Whether the loss has a minimum at ``x``: the next step is short, or no point nearby is better.
    """

    x: np.ndarray
    loss: float
    left: float
    converged: bool


@dataclass(frozen=True)
class Fit:
    """An estimate.

    Attributes:
        problem: The residuals that the last refinement minimised: on windows, or on longer segments.
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        search: Result of the search; None if it was skipped.
        windows: Segments of the search, and held-out segments of the same length.
        left: Largest move of a parameter in the next Gauss-Newton step [standard errors].
        converged: Whether the loss has a minimum at the estimate.
    """

    problem: Problem
    x: np.ndarray
    loss: float
    search: SearchResult | None
    windows: Problem
    left: float
    converged: bool

    @property
    def values(self) -> dict[str, float]:
        """The estimate by name."""
        return as_numbers(self.problem.table, self.x)

    def uncertainty(self) -> Uncertainty:
        """Return how uncertain the estimate is."""
        return from_linearised(self.problem, self.problem.linearise(self.x))


def as_numbers(table: ParameterTable, x: np.ndarray, present: np.ndarray | None = None) -> dict[str, float]:
    """Return values by name as Python numbers.

    Args:
        x: Shape ``(P,)``: a point on the parameters' scales.
        present: Shape ``(P,)``, bool: as in ``table.decode``.
    """
    return {n: v.tolist() for n, v in table.decode(x, present).items()}


def fit(
    windows: Problem,
    long_spans: Sequence[Span] = (),
    report: OnProgress | None = None,
    end: np.ndarray | None = None,
) -> Fit:
    """Identify a model.

    Args:
        windows: Segments to fit, and segments to predict.
        long_spans: Segments of the configuration's ``long_s`` for the last refinement.
        end: Shape ``(P,)``: the estimate of a fit of nearly this model. Only the last refinement is made, from there.
    """
    config, problem = windows.config, thinned(windows, of_recordings(windows), MOST_OF_FIT)
    # Refine from the nominal values, too, with short and with long delays: a delay may imitate an inertia.
    starts, result = problem.table.starts() if end is None else end[None], None
    # Search globally; its best candidate is a further start of the refinement.
    if config.generations and end is None:
        result = run_search(problem, starts[0], report)
        starts = np.stack([result.x, *starts])
    # Refine by least squares, first on windows, then on long segments.
    longer = bool(config.long_s and long_spans)
    if end is None or not longer:
        if end is None:
            # If all segments take long, first descend several times on some of them.
            few = few_of(problem)
            if few is not problem:
                starts = _refine(few, starts, report, _COARSE).x[None]
            found = _refine(problem, starts, report, _COARSE)
            starts = _at_other_delays(problem, found, report, takes_long=few is not problem).x[None]
        refined = _refine(problem, starts, report)
        if not longer:
            return Fit(problem, refined.x, refined.loss, result, windows, refined.left, refined.converged)
        starts = refined.x[None]
    problem = windows.recut(long_spans, config.long_s or 0.0)
    problem = thinned(problem, of_recordings(problem), MOST_OF_FIT)
    refined = _refine(problem, starts, report)
    return Fit(problem, refined.x, refined.loss, result, windows, refined.left, refined.converged)


def _at_other_delays(problem: Problem, found: Refined, report: OnProgress | None, takes_long: bool) -> Refined:
    """Return the best point of descents from other delays, or ``found`` if none is better.

    They begin at delays a quarter and half a period of the commands shorter and longer, and again beside each better
    end.

    A longer delay imitates an inertia: an arm's loss had a second minimum 7 ms above its delay of 20 ms, behind a
    ridge, with a fifth less armature.
    """
    table = problem.table
    delays = [i for i, c in enumerate(table.columns) if c.kind == "delay"]
    if not delays:
        return found
    nodes, lively = problem.rollouts.graph.nodes, problem.segments_with_most_motion(problem.part())
    period_s = 1.0 / min(nodes[name].rate for name in problem.model.given)
    for _ in range(_TRIES):
        x, starts = found.x, []
        J = problem.linearise(x, lively).jacobian.reshape(-1, len(x))
        for i, shift in itertools.product(delays, _SHIFTS):
            others, start, column = np.delete(np.arange(len(x)), i), x.copy(), table.columns[i]
            start[i] = column.to_scale(max(column.from_scale(x[i]) + shift * period_s, column.low))
            if start[i] == x[i]:  # there is no shorter delay
                continue
            # Move the other parameters as the linear model says; undetermined ones stay.
            start[others] -= np.linalg.lstsq(J[:, others], J[:, i] * (start[i] - x[i]), rcond=1e-6)[0]
            starts.append(table.within(start))
        other, least = refine(problem, np.stack(starts), lively, gain=ROUGH), problem.loss(x, lively)
        # A descent on all segments from the minimum of a few may end in another minimum; for EMPS its held-out errors
        # # were lower by a fifth. If it takes long, it is made for a better delay only.
        if takes_long:
            least = refine(problem, x[None], lively, gain=ROUGH).loss
        if not other.loss < (1.0 - ROUGH) * least:
            break
        better = _refine(problem, other.x[None], report, _COARSE)
        if not better.loss < found.loss:
            break
        found = better
    return found


def refit(problem: Problem, present: np.ndarray, near: np.ndarray) -> dict[str, float]:
    """Return a rough estimate of the present parameters; absent ones have their values without effect.

    The descent begins at the best of three points: the estimate of all parameters, a linear step from it, the start.

    Args:
        present: Shape ``(P,)``, bool: which free parameters are estimated.
        near: Shape ``(P,)``: the estimate of all parameters.
    """
    table = problem.table
    if not present.any():
        return as_numbers(table, near, present)
    few = few_of(problem)
    at, off = few.linearise(near), table.encode({p.name: p.without for p in table})
    J, moved = at.jacobian.reshape(-1, len(near)), np.where(present, 0.0, off - near)
    left = at.residuals.reshape(-1) + J @ moved
    moved[present] = -np.linalg.lstsq(J[:, present] * table.span[present], left, rcond=1e-6)[0] * table.span[present]
    part = few.part(present=present)
    starts = table.within(np.stack([near + moved, near, table.start()]))
    losses = np.nan_to_num([few.loss(x, part) for x in starts], nan=np.inf)
    best = starts[int(np.argmin(losses))]
    return as_numbers(table, refine(few, best[None], part, gain=ROUGH).x, present)


def run_search(problem: Problem, start: np.ndarray, report: OnProgress | None = None) -> SearchResult:
    """Search with the configuration of a problem.

    Args:
        start: Shape ``(P,)``: middle of the first generation.
    """
    config, table = problem.config, problem.table
    # Few segments suffice for a search: all 23 segments of an arm took 2.6 times as long.
    few = problem.segments_with_most_motion(problem.part())

    def losses(candidates: np.ndarray, middle: np.ndarray) -> np.ndarray:
        return problem.losses(candidates, middle, few)

    def advance(best: float, x: np.ndarray) -> None:
        if report:
            report("search", 1.0 / config.generations, best, x)

    result = search(losses, start, table.low, table.high, config, advance)
    result = replace(result, loss=problem.loss(result.x))
    if report:  # exact, while the losses of a generation linearise initial states at its middle
        report("search", 0.0, result.loss, result.x)
    return result


def refine(
    problem: Problem,
    starts: np.ndarray,
    part: Part | None = None,
    gain: float | None = None,
    on_step: OnStep | None = None,
    slopes: int | None = None,
) -> Refined:
    """Descend from each start, and from the best end to the minimum.

    Args:
        starts: Shape ``(K, P)``.
        part: Segments and parameters to fit; default: all.
        gain: Relative gain of the loss below which the descent ends, without a test for a minimum; default: descend to
            a minimum, and test it.
        slopes: Most Jacobians that a round computes, in few steps; default: as many as it needs.
    """
    descent = _Descent(problem, part or problem.part(), on_step, slopes)
    starts = problem.table.within(np.asarray(starts, np.float64))
    first = [descent.loss(x) for x in starts]
    if not np.isfinite(first).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )
    # Descend roughly from each start, and further from those that may lead to the best end.
    fine, first_gain = problem.precision, gain or _COARSE
    ends = list(starts[np.isfinite(first)])
    if len(ends) > 1:
        rough = sorted((descent.down(x, max(_ROUGHLY, first_gain)) for x in ends), key=lambda end: end[1])
        ends = [rough[0][0]]
        for x, loss in rough[1:]:
            apart = min(float(np.max(np.abs(x - y) / problem.table.span)) for y in ends)
            ends += [x] if loss < _NEARLY * rough[0][1] and apart > _APART else []
    x, loss = min((descent.down(x, first_gain) for x in ends), key=lambda end: end[1])
    if gain is not None:
        return Refined(x, loss, np.nan, False)
    # Descend from the best end to the minimum.
    x, loss = descent.down(x, fine)
    # Test whether the end is a minimum; if not, continue from a better point nearby.
    left, converged = remaining(problem, x, part), False
    for _ in range(_TRIES):
        if converged := left < _LEFT:
            break
        better = descent.better_nearby(x, loss)
        if converged := better is None:
            break
        x, loss = descent.down(better, fine)
        left = remaining(problem, x, part)
    return Refined(x, loss, left, converged)


def remaining(problem: Problem, x: np.ndarray, part: Part | None = None) -> float:
    """Return the largest move of a parameter in the next Gauss-Newton step [standard errors].

    A scale-free test of convergence (Bates and Watts, Technometrics 23, 1981). The step stops at the bounds.
    """
    part, table = part or problem.part(), problem.table
    at, rest = problem.linearise(x, part), np.flatnonzero(part.present)
    J, variance = at.jacobian.reshape(-1, len(x))[:, rest], loss_variance(problem, at)
    root = root_of_inverse(J.T @ J / variance + at.prior[np.ix_(rest, rest)])
    covariance = root @ root.T
    pull = _pull(table, part)
    step = -covariance @ (J.T @ at.residuals.reshape(-1) / variance + (pull**2 * (x - table.nominal()))[rest])
    low, high = table.low[rest] - x[rest], table.high[rest] - x[rest]
    return float(np.max(np.abs(np.clip(step, low, high)) / np.sqrt(np.diag(covariance)), initial=0.0))


def bounded_step(H: np.ndarray, g: np.ndarray, x: np.ndarray, table: ParameterTable, free: np.ndarray) -> np.ndarray:
    """Return the step ``(P,)`` to the minimum of a quadratic function within the bounds.

    A parameter that reaches its bound stays there while the others are optimised.

    Args:
        H: Shape ``(P, P)``: half the second derivatives; ``g`` is half the gradient at ``x``.
        free: Shape ``(P,)``, bool: which parameters move.
    """
    step, moving = np.zeros(len(x)), free.copy()
    for _ in range(len(x)):
        rest = np.flatnonzero(moving)
        unit = table.span[rest]
        rhs = (g + H[:, ~moving] @ step[~moving])[rest] * unit
        step[rest] = -unit * np.linalg.lstsq(H[np.ix_(rest, rest)] * np.outer(unit, unit), rhs, rcond=None)[0]
        beyond = moving & ((x + step < table.low) | (x + step > table.high))
        if not beyond.any():
            break
        step[beyond] = (np.clip(x + step, table.low, table.high) - x)[beyond]
        moving &= ~beyond
    return np.clip(x + step, table.low, table.high) - x


def _pull(table: ParameterTable, part: Part) -> np.ndarray:
    """Return how strongly each parameter is pulled to its nominal value, ``(P,)`` [1 / standard deviation].

    The pull is a prior as wide as the bounds, too weak to move a parameter that the log determines. Without it the
    first steps would carry away a parameter that hardly acts, and recordings that depend on it would be predicted
    wrongly.
    """
    pulled = np.array([c.kind != "delay" and c.prior is None for c in table.columns], bool)
    return np.where(pulled & part.present, 1.0 / table.span, 0.0)


class _Descent:
    """Descends on one part of a problem."""

    def __init__(self, problem: Problem, part: Part, on_step: OnStep | None, slopes: int | None = None) -> None:
        self._problem, self._part, self._on_step, self._slopes = problem, part, on_step, slopes
        self._best: tuple[float, np.ndarray] = (np.inf, np.zeros(0))
        self._nominal, self._weight = problem.table.nominal(), _pull(problem.table, part)
        self._deviation = 1.0

    def loss(self, x: np.ndarray) -> float:
        """Return the loss at a point, with initial states fitted there."""
        loss = self._problem.loss(x, self._part)
        self._report(loss, x)
        return loss

    def down(self, x: np.ndarray, gain: float) -> tuple[np.ndarray, float]:
        """Descend from a point until a round gains less than ``gain``; return the end and its loss.

        In a round, the derivatives by initial states stay as they were at its start. If the end turns out worse with
        derivatives computed there, the round goes back towards its start.
        """
        loss = self.loss(x)
        for _ in range(_ROUNDS):
            end = self._round(x, gain)
            before, after = loss + self._pulled(x), self.loss(end)
            for _ in range(_BACK):
                if after + self._pulled(end) <= before:
                    break
                end = (x + end) / 2.0
                after = self.loss(end)
            gained = before - after - self._pulled(end)
            if not gained > 0.0:
                break
            x, loss = end, after
            if gained < gain * loss:
                break
        return x, loss

    def better_nearby(self, x: np.ndarray, loss: float) -> np.ndarray | None:
        """Return a better point, seen before or within about a standard error; None if there is none."""
        if self._best[0] < (1.0 - _BETTER) * loss:
            return self._best[1]
        problem = self._problem
        at = problem.linearise(x, self._part)
        J, variance = at.jacobian.reshape(-1, len(x)), loss_variance(problem, at)
        root = root_of_inverse(J.T @ J / variance + at.prior)
        draws = np.random.default_rng(0).normal(size=(_POLLED, len(x)))
        points = problem.table.within(x + _AWAY * draws @ root.T)
        order = np.argsort(np.nan_to_num(problem.losses(points, x, self._part), nan=np.inf))
        # These losses linearise initial states at the point ``x``; compute the best one again.
        best = points[order[0]]
        return best if self.loss(best) < (1.0 - _BETTER) * loss else None

    def _pulled(self, x: np.ndarray) -> float:
        """Return the share of the loss that comes from the pull to the nominal values."""
        count = self._problem.compared(self._problem.part()).sum() * len(self._problem.fields)
        return 0.5 * float(np.sum((self._deviation * self._weight * (x - self._nominal)) ** 2) / max(count, 1))

    def _round(self, x: np.ndarray, gain: float) -> np.ndarray:
        """Return the end of a Levenberg-Marquardt descent from a point, within the bounds.

        It solves the small normal equations: scipy's solver decomposes the whole Jacobian in each step, which took
        longer than the rollouts of an arm.
        """
        problem, table, config = self._problem, self._problem.table, self._problem.config
        there = problem.near(x, self._part, self._slopes)
        free, near = self._part.present.copy(), max(_NEAR, problem.precision)

        def normal(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Return the robust residuals, half the gradient and half the second derivatives without the pull."""
            (r, stretch), J = robust(there.residuals(y), config.reach), there.jacobian(y)
            g, H = np.zeros(len(y)), np.zeros((len(y), len(y)))
            for first in range(0, len(r), _COLUMNS):
                some = slice(first, first + _COLUMNS)
                scaled = J[:, some] * stretch[some]
                g += scaled @ r[some]
                H += scaled @ scaled.T
            return r, g, H

        r, g, H = normal(x)
        if not (np.isfinite(r).all() and np.isfinite(H).all()):
            return x
        # End if no step can gain that share: failing steps took 12 evaluations of each refit without a part.
        step = bounded_step(H + 1e-12 * np.diag(table.span**-2), g, x, table, free)
        if -(2.0 * g @ step + step @ H @ step) < gain * float(r @ r):
            return x
        # The pull is relative to the residuals that the next step should leave.
        shape, priors = (len(self._part.live), -1, len(problem.fields)), sum(c.prior is not None for c in table.columns)
        stretch = robust(there.residuals(x), config.reach)[1]
        left = r + stretch * (step @ there.jacobian(x))
        compared = problem.compared(self._part)
        self._deviation = deviation(left[: len(left) - priors].reshape(shape), compared)
        pull, damping, failed, y = (self._deviation * self._weight) ** 2, _DAMPING, 0, x
        cost = float(r @ r) + float(pull @ (y - self._nominal) ** 2)
        most = config.refine_steps if self._slopes is None else min(config.refine_steps, _SHORT)
        for _ in range(max(1, most)):
            G, A = g + pull * (y - self._nominal), H + np.diag(pull)
            A = A + damping * np.diag(np.maximum(np.diag(A), 1e-9 * np.max(np.diag(A) * table.span**2) / table.span**2))
            step = bounded_step(A, G, y, table, free)
            predicted = -(2.0 * G @ step + step @ (H + np.diag(pull)) @ step)
            raw = there.residuals(y + step)
            self._report(np.inf, y + step)
            new = robust(raw, config.reach)[0]
            after = float(new @ new) + float(pull @ (y + step - self._nominal) ** 2)
            gained = cost - after if np.isfinite(after) else -np.inf
            if not gained > 0.0:
                if there.renew(y):
                    r, g, H = normal(y)
                    continue
                damping, failed = damping * _HARDER, failed + 1
                if np.max(np.abs(step) / table.span) < near or failed == _FAILED:
                    break
                continue
            failed, damping = 0, max(damping * (_EASIER if gained > 0.5 * predicted else 1.0), _DAMPING * _EASIER)
            y, cost = y + step, after
            small = gained < gain * cost and gained > _AS_PREDICTED * predicted
            if small or np.max(np.abs(step) / table.span) < near:
                break
            r, g, H = normal(y)
        return y

    def _report(self, loss: float, x: np.ndarray) -> None:
        if loss < self._best[0]:
            self._best = (loss, x.copy())
        if self._on_step and np.isfinite(self._best[0]):
            self._on_step(*self._best)


def _refine(problem: Problem, starts: np.ndarray, report: OnProgress | None, gain: float | None = None) -> Refined:
    """Descend from starts to the minimum, with reports."""
    left, share = 1.0, 0.5 / (problem.config.refine_steps * (1 + len(starts)))

    def advance(best: float, x: np.ndarray) -> None:
        nonlocal left
        step = min(share, left / 2.0)  # the number of evaluations is unknown in advance
        left -= step
        if report:
            report("refine", step, best, x)

    return refine(problem, starts, gain=gain, on_step=advance)
