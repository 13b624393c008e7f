"""From recordings to an estimate: search on windows, refine, refine on longer segments."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.identification import Refinement, Search
from sim2real.graph.episode import Episode
from sim2real.identify.config import FitConfig
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.programs import OnCompile
from sim2real.identify.problem.segments import Data, Span
from sim2real.identify.problem.thinned import MOST_OF_FIT, few_of, of_recordings, thinned
from sim2real.identify.search.refine import Refined, refine, remaining
from sim2real.identify.search.search import SearchResult, search
from sim2real.identify.uncertainty.uncertainty import Uncertainty, uncertainty

INSIDE = 0.01
"""Distance from a bound at which the fit of a parameter begins [widths of the bounds]."""
_ROUGHLY = 0.05
"""Relative gain of the loss in a step at which a descent ends that only finds a start."""
_OFF_BOUNDS = 3.0
"""Limit of ``|z|`` at the start of a search: the middle 90 % of the bounds."""
_CONVERGED = 0.5
"""A fit without refinement has converged if the next Gauss-Newton step is shorter [standard errors]."""
OnProgress = Callable[[str, float, float, np.ndarray], None]
"""Called with the phase (``search``, ``refine`` or ``compiling``), the share of it done since the last call, and the
best loss and point so far."""
Value: TypeAlias = float | list[float]
"""The value of a parameter: a number, or a list with one number a recording."""


@dataclass(frozen=True)
class Fit:
    """An estimate.

    Attributes:
        problem: The residuals of the last refinement: on windows, or on longer segments.
        z: Shape ``(P,)``: the estimate.
        search: Result of the search; None if it was skipped.
        refined: Results of the refinements, in order.
        windows: Segments of the search, and held-out segments of the same length.
        left: Length of the next Gauss-Newton step [standard errors], of the parameter that it moves most.
        converged: Whether the loss has a minimum at the estimate.
    """

    problem: Problem
    z: np.ndarray
    loss: float
    search: SearchResult | None
    refined: tuple[Refined, ...]
    windows: Problem
    left: float
    converged: bool

    @property
    def values(self) -> dict[str, Value]:
        """The estimate by name."""
        return as_numbers(self.problem.table, self.z)

    @property
    def record(self) -> Search:
        """How search and refinement went, for the artifact."""
        refined = tuple(Refinement(r.before, r.loss, r.steps) for r in self.refined)
        record = self.search.record if self.search else Search()
        return replace(record, refined=refined, engine=str(self.problem.engine))

    def uncertainty(self) -> Uncertainty:
        """Return how uncertain the estimate is."""
        return uncertainty(self.problem, self.z)


def as_numbers(table: ParameterTable, z: np.ndarray, present: np.ndarray | None = None) -> dict[str, Value]:
    """Return values by name as Python numbers; lists for parameters that each recording has its own value of.

    Args:
        z: Shape ``(P,)``: the unbounded vector.
        present: Shape ``(P,)``, bool: as in ``table.decode``.
    """
    return {
        n: np.asarray(v, np.float64).tolist() for n, v in table.decode(jnp.asarray(z, jnp.float32), present).items()
    }


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
    z, loss = starts[0], float("nan")
    # Search globally; its best candidate is a further start of the refinement.
    if config.generations and end is None:
        result = run_search(problem, starts[0], report)
        starts = np.stack([result.z, *starts])
        z, loss = result.z, result.loss
    # Refine by least squares, first on windows, then on long segments.
    refined, longer = list[Refined](), bool(config.refine_steps and config.long_s and long_spans)
    if config.refine_steps and as_start and problem.table.terms:
        refined += _roughly(problem, starts, report)
    elif config.refine_steps and (end is None or not longer):
        # Where all segments take long, the best of several descents on some of them begins the descent on all.
        few = few_of(problem) if end is None else problem
        refined += [_refine(few, starts, report)] if few is not problem else []
        refined.append(_refine(problem, refined[0].z[None] if refined else starts, report))
    if longer:
        problem = windows.recut(long_spans, config.long_s or 0.0)
        problem = thinned(problem, of_recordings(problem), MOST_OF_FIT)
        refined.append(_refine(problem, refined[-1].z[None] if refined else starts, report))
    # Test whether the end is a minimum.
    if refined:
        z, loss, left, converged = refined[-1].z, refined[-1].loss, refined[-1].left, refined[-1].converged
        loss = problem.loss(z) if as_start else loss  # a start is found on some of the segments
    else:
        left = remaining(problem, z)
        converged = left < _CONVERGED
    return Fit(problem, z, loss, result, tuple(refined), windows, left, converged)


def refit(problem: Problem, present: np.ndarray, near: np.ndarray) -> dict[str, Value]:
    """Return the estimate of fewer parameters, by refinement; the others have their values in a model without them.

    Args:
        present: Shape ``(P,)``, bool: which free parameters are estimated.
        near: Shape ``(P,)``: the estimate of all parameters, one of two starts; the other is the table's.
    """
    table = problem.table
    if not present.any():
        return as_numbers(table, near, present)
    starts, few = np.stack([table.encode(as_numbers(table, near)), table.start()]), few_of(problem)
    return as_numbers(table, refine(few, starts, few.part(present=present), coarse=True).z, present)


def run_search(problem: Problem, start: np.ndarray, report: OnProgress | None = None) -> SearchResult:
    """Search with the configuration of a problem.

    Args:
        start: Shape ``(P,)``: middle of the first generation.
    """
    # At a bound the map to values is flat, and a search that begins there stays there.
    start = np.clip(start, -_OFF_BOUNDS, _OFF_BOUNDS)
    config = problem.config

    def advance(best: float, z: np.ndarray) -> None:
        if report:
            report("search", 1.0 / config.generations, best, z)

    _compiling(report, "search", start)(True)
    result = search(problem.evaluator.searched(problem.data), start, config, advance)
    result = replace(result, loss=problem.loss(result.z))
    if report:  # this loss is exact; a generation's losses linearise initial states at its middle
        report("search", 0.0, result.loss, result.z)
    return result


def opened(table: ParameterTable, z: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return a point with the terms of a set near their values without effect, the others at them, ``(P,)``.

    Parameters stay a little inside of their bounds, where the map to values is flat and a descent would not move them.

    Args:
        present: Shape ``(T,)``, bool: which terms.
    """
    there, x = table.of_terms(present), table.scale(z)[0]
    inside = INSIDE * table.span
    for i, column in enumerate(table.columns):
        p = column.parameter
        off = p.to_scale(min(max(p.without, p.low), p.high))
        x[i] = np.clip(x[i], table.low[i] + inside[i], table.high[i] - inside[i]) if there[i] else off
    return table.at_scale(x)


def _roughly(problem: Problem, starts: np.ndarray, report: OnProgress | None) -> list[Refined]:
    """Return the ends of rough descents without optional terms, and from the best one with all of them.

    At nominal values the terms hide what the others explain, and each term makes a Jacobian larger.
    """
    table = problem.table
    none, every = np.zeros(len(table.terms), bool), np.ones(len(table.terms), bool)
    without = problem.part(present=table.of_terms(none))
    begun = [opened(table, z, none) for z in starts]
    first = _refine(problem, np.stack(begun), report, problem.evaluator.lively(without))
    first = _refine(problem, first.z[None], report, without)
    return [
        first,
        _refine(problem, opened(table, first.z, every)[None], report, problem.evaluator.lively(problem.data)),
    ]


def _refine(problem: Problem, starts: np.ndarray, report: OnProgress | None, roughly: Data | None = None) -> Refined:
    """Descend from starts.

    Args:
        roughly: Segments and parameters of a descent that only has to come near a minimum; None: to the minimum.
    """
    left, share = 1.0, 0.5 / (problem.config.refine_steps * (1 + len(starts)))

    def advance(best: float, z: np.ndarray) -> None:
        nonlocal left
        step = min(share, left / 2.0)  # the number of evaluations is unknown in advance
        left -= step
        if report:
            report("refine", step, best, z)

    compiling = _compiling(report, "refine", starts[0])
    if roughly is None:
        return refine(problem, starts, on_step=advance, on_compile=compiling)
    return refine(problem, starts, roughly, settle=False, gain=_ROUGHLY, on_step=advance, on_compile=compiling)


def _compiling(report: OnProgress | None, then: str, z: np.ndarray) -> OnCompile:
    """Return a function that reports a compilation, after which the phase ``then`` continues."""

    def on_compile(started: bool) -> None:
        if report:
            report("compiling" if started else then, 0.0, float("inf"), z)

    return on_compile
