"""From recordings to an estimate: search on windows, refine, refine on longer stretches."""

from __future__ import annotations

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
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import Refined, refine, remaining
from sim2real.identify.search.search import SearchResult, search
from sim2real.identify.uncertainty.uncertainty import Uncertainty, centred, uncertainty

_OFF_BOUNDS = 3.0
"""A search begins within the middle 90 % of the bounds."""
_CONVERGED = 0.5
"""A fit without refinement has converged where less is left of the next Gauss-Newton step, in standard errors."""
OnProgress = Callable[[str, float, float, np.ndarray], None]
"""Called with the phase (``search``, ``refine`` or ``compiling``), the share of it done since the last call, and the
best loss and point so far."""
Value: TypeAlias = float | list[float]
"""The value of a parameter: a number, or a list with one number a recording."""


@dataclass(frozen=True)
class Fit:
    """An estimate.

    Attributes:
        problem: The residuals that were minimised last: on windows, or on longer segments.
        z: Shape ``(P,)``: the estimate.
        loss: Its loss there.
        search: What the search found; None where it was left out.
        refined: How each refinement ended, in order.
        windows: Segments that were searched on, and held-out segments of the same length.
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
        """The estimate by name: a number, or a list of one for each recording."""
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


def as_numbers(table: ParameterTable, z: np.ndarray, kept: np.ndarray | None = None) -> dict[str, Value]:
    """Return values by name as Python numbers, lists where each recording has its own.

    Args:
        z: Shape ``(P,)``: the unbounded vector.
        kept: Shape ``(P,)``, bool: as in ``table.decode``.
    """
    return {n: np.asarray(v, np.float64).tolist() for n, v in table.decode(jnp.asarray(z, jnp.float32), kept).items()}


def fit(
    model: IdentifiableModel,
    recordings: Sequence[Episode],
    spans: Sequence[Span],
    length_s: float,
    config: FitConfig,
    table: ParameterTable | None = None,
    long_spans: Sequence[Span] = (),
    report: OnProgress | None = None,
    begins: Callable[[Problem], None] | None = None,
) -> Fit:
    """Identify a model.

    Args:
        spans: Segments to search and refine on, and others to predict.
        length_s: Their length [s].
        table: The parameters; default: the model's.
        long_spans: Segments of ``config.long_s`` for the last refinement.
    """
    problem = windows = Problem(model, recordings, spans, length_s, config, table)
    if begins:
        begins(problem)
    # Also from the middle, and with longer delays: a descent may end where a delay, say, stands for an inertia.
    starts, found = problem.table.starts(), None
    z, loss = starts[0], float("nan")
    if config.generations:
        found = run_search(problem, starts[0], report)
        starts = np.stack([*found.finalists[: config.refine], starts[0]])
        z, loss = found.z, found.loss
    refined = []
    if config.refine:
        refined.append(_refine(problem, starts, report))
    if config.refine and config.long_s and long_spans:
        problem = problem.recut(long_spans, config.long_s)
        refined.append(_refine(problem, refined[-1].z[None], report))
    if refined:
        z, loss, left, converged = refined[-1].z, refined[-1].loss, refined[-1].left, refined[-1].converged
    else:
        z = centred(problem.table, z)
        left = remaining(problem, z)
        converged = left < _CONVERGED
    return Fit(problem, z, loss, found, tuple(refined), windows, left, converged)


def refit(problem: Problem, kept: np.ndarray, near: np.ndarray) -> dict[str, Value]:
    """Estimate fewer parameters, by refinement alone; the others are held at what a model without them has.

    Args:
        problem: The residuals, with all parameters.
        kept: Shape ``(P,)``, bool: which free parameters are estimated.
        near: Shape ``(P,)``: the estimate of all parameters, one of two starts; the other is the table's own.

    Returns:
        The estimate by name.
    """
    table = problem.table
    if not kept.any():
        return as_numbers(table, near, kept)
    starts = np.stack([table.encode(as_numbers(table, near)), table.start()])
    return as_numbers(table, refine(problem, starts, problem.part(kept=kept), coarse=True).z, kept)


def run_search(problem: Problem, start: np.ndarray, report: OnProgress | None = None) -> SearchResult:
    """Search as the problem's configuration says.

    Args:
        start: Shape ``(P,)``: middle of the first generation.
    """
    total = problem.config.generations * (1 + problem.config.restarts)
    # At a bound the map to values is flat: a search that begins there does not get away.
    start = np.clip(start, -_OFF_BOUNDS, _OFF_BOUNDS)

    def advance(generations: int, best: float, z: np.ndarray) -> None:
        if report:
            report("search", generations / total, best, z)

    compiling, data, config = _compiling(report, "search", start), problem.data, problem.config
    free = config.initial_state == "free"
    # How a search shares the delays' sum between both sides of the world means nothing: see ``centred``.
    middle = lambda z: centred(problem.table, z) if free else z  # noqa: E731
    alone = lambda z: problem.loss(middle(z), on_compile=compiling)  # noqa: E731
    given = (data, np.asarray(data.weight), advance)
    found = search(
        problem.evaluator.searched(data),
        start,
        config,
        *given,
        problem.residuals.searches,
        compiling,
        alone,
        host=problem.engine.name == "c",
    )
    finalists = np.array([middle(z) for z in found.finalists])
    found = replace(found, z=finalists[0], finalists=finalists)
    if report:  # the loss of the best candidate by itself: before, initial states were those of its generation's middle
        report("search", 0.0, found.loss, found.z)
    return found


def _refine(problem: Problem, starts: np.ndarray, report: OnProgress | None) -> Refined:
    left, share = 1.0, 0.5 / (problem.config.refine_steps * (1 + len(starts)))

    def advance(best: float, z: np.ndarray) -> None:
        nonlocal left
        step = min(share, left / 2.0)  # how many evaluations there will be is not known
        left -= step
        if report:
            report("refine", step, best, z)

    return refine(problem, starts, on_step=advance, on_compile=_compiling(report, "refine", starts[0]))


def _compiling(report: OnProgress | None, then: str, z: np.ndarray) -> OnCompile:
    """Return what reports that programs are compiled, before the phase ``then`` goes on."""

    def on_compile(started: bool) -> None:
        if report:
            report("compiling" if started else then, 0.0, float("inf"), z)

    return on_compile
