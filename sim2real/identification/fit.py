"""From recordings to an estimate: search on windows, descend by least squares, descend on longer segments.

scipy's trust-region method takes the steps of a descent, within the bounds and with a robust loss. The loss that
decides is that with initial states solved for at the point itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim2real.artifacts.identification import Search
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identification.config import FitConfig
from sim2real.identification.model import IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.problem import MOST_OF_FIT, Problem, few_of, of_recordings, thinned
from sim2real.identification.residuals import Part, robust
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
"""Relative gain of the loss in a step at which a descent ends that only finds a start."""
_COARSE = 1e-3
"""Relative gain of the loss at which the descent from each start ends; that from the best start continues."""
_ROUGH = 1e-2
"""The same for a model that others are compared with by percents."""
_ROUNDS, _BACK = 4, 4
"""Most rounds of a descent, and how often a round goes half the way back to its start."""
_NEAR = 1e-5
"""Relative change of the point at which a descent ends, if the differences resolve it."""
_LEFT = 0.1
"""A descent has converged if the next Gauss-Newton step is shorter [standard errors]."""
_CONVERGED = 0.5
"""The same for a fit without a descent."""
_POLLED, _AWAY, _BETTER = 12, 0.5, 1e-3
"""Points that are tried around a descent that ended with more left; how far away [standard errors]; and by which share
their loss must be lower. Where friction sticks, the derivative at a point does not describe the points around it."""
_TRIES = 3
_LOSSES = {"squared": "linear", "huber": "soft_l1", "cauchy": "cauchy"}
"""Names of the losses in scipy."""
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
        before: Loss of the best start.
        steps: Evaluations, of all starts.
        left: Length of the next Gauss-Newton step [standard errors], of the parameter that it moves most.
        converged: Whether the loss has a minimum there: the next step is short, or no point around is better.
    """

    x: np.ndarray
    loss: float
    before: float
    steps: int
    left: float
    converged: bool


@dataclass(frozen=True)
class Fit:
    """An estimate.

    Attributes:
        problem: The residuals of the last refinement: on windows, or on longer segments.
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        search: Result of the search; None if it was skipped.
        refined: Results of the refinements, in order.
        windows: Segments of the search, and held-out segments of the same length.
        left: Length of the next Gauss-Newton step [standard errors], of the parameter that it moves most.
        converged: Whether the loss has a minimum at the estimate.
    """

    problem: Problem
    x: np.ndarray
    loss: float
    search: SearchResult | None
    refined: tuple[Refined, ...]
    windows: Problem
    left: float
    converged: bool

    @property
    def values(self) -> dict[str, float]:
        """The estimate by name."""
        return as_numbers(self.problem.table, self.x)

    @property
    def record(self) -> Search:
        """How search and refinement went, for the artifact."""
        return replace(self.search.record if self.search else Search(), engine=str(self.problem.engine))

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
    model: IdentifiableModel,
    recordings: Sequence[Episode],
    spans: Sequence[Span],
    length_s: float,
    config: FitConfig,
    table: ParameterTable | None = None,
    long_spans: Sequence[Span] = (),
    report: OnProgress | None = None,
    on_begin: Callable[[Problem], None] | None = None,
    as_start: bool = False,
    end: np.ndarray | None = None,
) -> Fit:
    """Identify a model.

    Args:
        spans: Segments to fit, and segments to predict.
        length_s: Length of a segment [s].
        long_spans: Segments of ``config.long_s`` for the last refinement.
        as_start: Whether the fit only has to be a start for fits with some of the optional terms.
        end: Shape ``(P,)``: where a fit of nearly this model ended. Only the last refinement is made, from there: one
            on windows may leave a minimum that long segments have.
    """
    windows = Problem(model, recordings, spans, length_s, config, table)
    problem = thinned(windows, of_recordings(windows), MOST_OF_FIT)
    if on_begin:
        on_begin(problem)
    # Refine from the nominal values, too, with short and with long delays: a delay may imitate an inertia.
    starts, result = problem.table.starts() if end is None else end[None], None
    x, loss = starts[0], float("nan")
    # Search globally; its best candidate is a further start of the refinement.
    if config.generations and end is None:
        result = run_search(problem, starts[0], report)
        starts = np.stack([result.x, *starts])
        x, loss = result.x, result.loss
    # Refine by least squares, first on windows, then on long segments.
    refined, longer = list[Refined](), bool(config.refine_steps and config.long_s and long_spans)
    if config.refine_steps and as_start and problem.table.terms:
        refined += _roughly(problem, starts, report)
    elif config.refine_steps and (end is None or not longer):
        # Where all segments take long, the best of several descents on some of them begins the descent on all.
        few = few_of(problem) if end is None else problem
        refined += [_refine(few, starts, report)] if few is not problem else []
        refined.append(_refine(problem, refined[0].x[None] if refined else starts, report))
    if longer:
        problem = windows.recut(long_spans, config.long_s or 0.0)
        problem = thinned(problem, of_recordings(problem), MOST_OF_FIT)
        refined.append(_refine(problem, refined[-1].x[None] if refined else starts, report))
    # Test whether the end is a minimum.
    if refined:
        x, loss, left, converged = refined[-1].x, refined[-1].loss, refined[-1].left, refined[-1].converged
        loss = problem.loss(x) if as_start else loss  # a start is found on some of the segments
    else:
        left = remaining(problem, x)
        converged = left < _CONVERGED
    return Fit(problem, x, loss, result, tuple(refined), windows, left, converged)


def refit(problem: Problem, present: np.ndarray, near: np.ndarray) -> dict[str, float]:
    """Return a rough estimate of fewer parameters; the others have their values in a model without them.

    Args:
        present: Shape ``(P,)``, bool: which free parameters are estimated.
        near: Shape ``(P,)``: the estimate of all parameters, one of two starts; the other is the table's.
    """
    table = problem.table
    if not present.any():
        return as_numbers(table, near, present)
    starts, few = np.stack([near, table.start()]), few_of(problem)
    return as_numbers(table, refine(few, starts, few.part(present=present), coarse=True).x, present)


def run_search(problem: Problem, start: np.ndarray, report: OnProgress | None = None) -> SearchResult:
    """Search with the configuration of a problem.

    Args:
        start: Shape ``(P,)``: middle of the first generation.
    """
    config, table = problem.config, problem.table
    part = problem.part()
    losses = problem.residuals.generations(part)

    def advance(best: float, x: np.ndarray) -> None:
        if report:
            report("search", 1.0 / config.generations, best, x)

    result = search(losses, start, table.low, table.high, config, advance)
    result = replace(result, loss=problem.loss(result.x))
    if report:  # this loss is exact; a generation's losses linearise initial states at its middle
        report("search", 0.0, result.loss, result.x)
    return result


def refine(
    problem: Problem,
    starts: np.ndarray,
    part: Part | None = None,
    coarse: bool = False,
    settle: bool = True,
    gain: float | None = None,
    on_step: OnStep | None = None,
) -> Refined:
    """Descend from each start, and from the best end to the minimum.

    Args:
        starts: Shape ``(K, P)``.
        part: Segments and parameters to fit; default: all.
        coarse: Whether the first descents suffice, to compare with a model by percents.
        settle: Whether the end is tested, and points around it are tried if it is no minimum.
        gain: Relative gain of the loss at which the first descents end; default: by the other arguments.
    """
    descent = _Descent(problem, part or problem.part(), on_step)
    starts = problem.table.within(np.asarray(starts, np.float64))
    first = [descent.loss(x) for x in starts]
    if not np.isfinite(first).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )
    # Descend roughly from each start.
    fine = problem.residuals.precision
    first_gain = gain or (_ROUGH if coarse else _COARSE if settle else fine)
    x, loss = min((descent.down(x, first_gain) for x in starts[np.isfinite(first)]), key=lambda end: end[1])
    if coarse or not settle:
        return Refined(x, loss, float(np.nanmin(first)), descent.steps, np.nan, False)
    # Descend from the best end to the minimum.
    x, loss = descent.down(x, fine)
    # Test the end; if it is no minimum, continue from a better point nearby.
    left, converged = remaining(problem, x, part), False
    for _ in range(_TRIES):
        if converged := left < _LEFT:
            break
        better = descent.better_nearby(x, loss)
        if converged := better is None:
            break
        x, loss = descent.down(better, fine)
        left = remaining(problem, x, part)
    return Refined(x, loss, float(np.nanmin(first)), descent.steps, left, converged)


def remaining(problem: Problem, x: np.ndarray, part: Part | None = None) -> float:
    """Return how much is left of a descent: the largest move of the next Gauss-Newton step [standard errors].

    A scale-free test of convergence (Bates and Watts, Technometrics 23, 1981). Where the step leaves the bounds it ends
    there.
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


def _pull(table: ParameterTable, part: Part) -> np.ndarray:
    """Return how strongly each parameter is pulled to its nominal value, ``(P,)`` [1 / deviation].

    A deviation of the bounds' width is too wide to matter to a parameter that the log determines. Without it the first
    steps carry one that hardly acts anywhere, and recordings that depend on it are predicted wrongly.
    """
    pulled = np.array([c.kind != "delay" and c.prior is None for c in table.columns], bool)
    return np.where(pulled & part.present, 1.0 / table.span, 0.0)


class _Descent:
    """Descends on one part of a problem.

    Attributes:
        steps: Evaluations so far.
    """

    def __init__(self, problem: Problem, part: Part, on_step: OnStep | None) -> None:
        self._problem, self._part, self._on_step = problem, part, on_step
        self._best: tuple[float, np.ndarray] = (np.inf, np.zeros(0))
        self._nominal, self._weight = problem.table.nominal(), _pull(problem.table, part)
        self._deviation = 1.0
        self.steps = 0

    def loss(self, x: np.ndarray) -> float:
        """Return the loss at a point, where initial states are linearised there."""
        loss = self._problem.loss(x, self._part)
        self._report(loss, x)
        return loss

    def down(self, x: np.ndarray, gain: float) -> tuple[np.ndarray, float]:
        """Descend from a point until a round gains a smaller share of the loss; return where that ends, and its loss.

        In a round initial states keep the slopes that they have at its start. Where the loss is larger at its end once
        they are linearised there, the round goes back towards its start.
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
        """Return a point that is better, seen before or within about a standard error; None if none of those is."""
        if self._best[0] < (1.0 - _BETTER) * loss:
            return self._best[1]
        problem = self._problem
        at = problem.linearise(x, self._part)
        J, variance = at.jacobian.reshape(-1, len(x)), loss_variance(problem, at)
        root = root_of_inverse(J.T @ J / variance + at.prior)
        draws = np.random.default_rng(0).normal(size=(_POLLED, len(x)))
        points = problem.table.within(x + _AWAY * draws @ root.T)
        order = np.argsort(np.nan_to_num(problem.losses(points, x, self._part), nan=np.inf))
        # The losses linearise initial states at the point itself; the best is computed again.
        best = points[order[0]]
        return best if self.loss(best) < (1.0 - _BETTER) * loss else None

    def _pulled(self, x: np.ndarray) -> float:
        """Return what the pull to the nominal values adds to the loss."""
        count = self._problem.residuals.compared(self._problem.part()).sum() * len(self._problem.fields)
        return 0.5 * float(np.sum((self._deviation * self._weight * (x - self._nominal)) ** 2) / max(count, 1))

    def _round(self, x: np.ndarray, gain: float) -> np.ndarray:
        """Return where least squares ends from a point."""
        from scipy.optimize import least_squares  # 0.2 s

        problem, table, config = self._problem, self._problem.table, self._problem.config
        value, slope = problem.residuals.near(x, self._part)
        first, J = value(x), slope(x)
        if not (np.isfinite(first).all() and np.isfinite(J).all()):
            return x
        # End where no step can gain that share: steps that fail took 12 evaluations of each refit without a part.
        r, stretch = robust(first, config.loss, config.reach)
        basis = np.linalg.qr((stretch[:, None] * J * table.span)[:, self._part.present])[0]
        left = r - basis @ (basis.T @ r)
        if 1.0 - (left @ left) / max(float(r @ r), 1e-300) < gain:
            return x
        # Pull to the nominal values by the residuals that the next step leaves, if the slope is right.
        shape = (len(self._part.live), -1, len(problem.fields))
        priors = sum(c.prior is not None for c in table.columns)
        self._deviation = deviation(left[: len(left) - priors].reshape(shape), problem.residuals.compared(self._part))
        rows, pull = np.flatnonzero(self._weight), self._deviation * self._weight

        def pulled(y: np.ndarray) -> np.ndarray:
            self._report(np.inf, y)
            return np.nan_to_num(np.append(value(y), (pull * (y - self._nominal))[rows]), nan=np.inf)

        def pulled_slope(y: np.ndarray) -> np.ndarray:
            return np.vstack([slope(y), np.diag(pull)[rows]])

        robustly: Any = {"loss": _LOSSES[config.loss], "f_scale": config.reach, "jac": pulled_slope, "gtol": None}
        near, most = max(_NEAR, problem.residuals.precision), max(1, config.refine_steps)
        bounds = (table.low, table.high)
        end = least_squares(
            pulled, x, bounds=bounds, x_scale=table.span, ftol=gain, xtol=near, max_nfev=most, **robustly
        )
        return np.asarray(end.x, np.float64)

    def _report(self, loss: float, x: np.ndarray) -> None:
        self.steps += 1
        if loss < self._best[0]:
            self._best = (loss, x.copy())
        if self._on_step and np.isfinite(self._best[0]):
            self._on_step(*self._best)


def with_terms(table: ParameterTable, x: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return a point with the parameters of absent terms at their values without effect, ``(P,)``.

    Args:
        present: Shape ``(T,)``, bool: which of the table's terms.
    """
    off = [p.to_scale(min(max(p.without, p.low), p.high)) for p in (c for c in table.columns)]
    return np.where(table.of_terms(present), x, off)


def _roughly(problem: Problem, starts: np.ndarray, report: OnProgress | None) -> list[Refined]:
    """Return the ends of rough descents without optional terms, and from the best one with all of them.

    At nominal values the terms hide what the others explain, and each term makes a Jacobian larger.
    """
    table, residuals = problem.table, problem.residuals
    none = np.zeros(len(table.terms), bool)
    without = problem.part(present=table.of_terms(none))
    begun = np.stack([with_terms(table, x, none) for x in starts])
    first = _refine(problem, begun, report, residuals.liveliest(without))
    first = _refine(problem, first.x[None], report, without)
    return [first, _refine(problem, first.x[None], report, residuals.liveliest(problem.part()))]


def _refine(problem: Problem, starts: np.ndarray, report: OnProgress | None, roughly: Part | None = None) -> Refined:
    """Descend from starts.

    Args:
        roughly: Segments and parameters of a descent that only has to come near a minimum; None: to the minimum.
    """
    left, share = 1.0, 0.5 / (problem.config.refine_steps * (1 + len(starts)))

    def advance(best: float, x: np.ndarray) -> None:
        nonlocal left
        step = min(share, left / 2.0)  # the number of evaluations is unknown in advance
        left -= step
        if report:
            report("refine", step, best, x)

    if roughly is None:
        return refine(problem, starts, on_step=advance)
    return refine(problem, starts, roughly, settle=False, gain=_ROUGHLY, on_step=advance)
