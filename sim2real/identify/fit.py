"""From recordings to an estimate: search on windows, refine, refine on longer stretches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.graph.episode import Episode
from sim2real.identify.config import FitConfig
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem
from sim2real.identify.refine import Refined, effort, refine
from sim2real.identify.search import SearchResult, search
from sim2real.identify.segments import Span
from sim2real.identify.uncertainty import Uncertainty, centred, uncertainty

_OFF_BOUNDS = 3.0
"""A search begins within the middle 90 % of the bounds."""
_ROUNDS = 3
"""Most rounds of a refinement."""
_COARSE = 1e-2
"""A baseline is compared with by percents: a round that gains less is its last."""
Told = Callable[[str, float, float, np.ndarray], None]
"""Called with the phase (``search`` or ``refine``; ``compiling`` in between), the share of it done since the last call,
and the best loss and point so far."""


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
    """

    problem: Problem
    z: np.ndarray
    loss: float
    search: SearchResult | None
    refined: tuple[Refined, ...]
    windows: Problem

    @property
    def values(self) -> dict[str, Any]:
        """The estimate by name: a number, or a list of one for each recording."""
        return as_numbers(self.problem.table, self.z)

    def uncertainty(self) -> Uncertainty:
        """Return how uncertain the estimate is."""
        return uncertainty(self.problem, self.z)


def as_numbers(table: ParameterTable, z: np.ndarray, kept: np.ndarray | None = None) -> dict[str, Any]:
    """Return values by name as Python numbers, lists where each recording has its own.

    Args:
        table: The parameters.
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
    told: Told | None = None,
    begins: Callable[[Problem], None] | None = None,
) -> Fit:
    """Identify a model.

    Args:
        model: The model.
        recordings: The logs.
        spans: Segments to search and refine on, and others to predict.
        length_s: Their length [s].
        config: How.
        table: The parameters; default: the model's.
        long_spans: Segments of ``config.long_s`` for the last refinement.
        told: Progress.
        begins: Called with the residuals before anything is compiled.
    """
    problem = windows = Problem(model, recordings, spans, length_s, config, table)
    if begins:
        begins(problem)
    # Also from the middle, and with longer delays: a descent may end where a delay, say, stands for an inertia.
    starts, found = problem.table.starts(), None
    z, loss = starts[0], float("nan")
    if config.generations:
        found = run_search(problem, starts[0], told)
        starts = np.stack([*found.finalists[: config.refine], starts[0]])
        z, loss = found.z, found.loss
    refined = []
    if config.refine:
        refined.append(_refine(problem, starts, told))
        z, loss = refined[-1].z, refined[-1].loss
    if config.refine and config.long_s and long_spans:
        problem = Problem(model, recordings, long_spans, config.long_s, config, table)
        refined.append(_refine(problem, z[None], told))
        z, loss = refined[-1].z, refined[-1].loss
    return Fit(problem, centred(problem, z), loss, found, tuple(refined), windows)


def refit(problem: Problem, kept: np.ndarray, near: np.ndarray) -> dict[str, Any]:
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
    ended = refine(problem, starts, *effort(problem, _ROUNDS), data=problem.part(kept=kept), gain=_COARSE)
    return as_numbers(table, ended.z, kept)


def run_search(problem: Problem, start: np.ndarray, told: Told | None = None) -> SearchResult:
    """Search as the problem's configuration says.

    Args:
        problem: The residuals.
        start: Shape ``(P,)``: middle of the first generation.
        told: Progress.
    """
    total = problem.config.generations * (1 + problem.config.restarts)
    # At a bound the map to values is flat: a search that begins there does not get away.
    start = np.clip(start, -_OFF_BOUNDS, _OFF_BOUNDS)

    def advance(generations: int, best: float, z: np.ndarray) -> None:
        if told:
            told("search", generations / total, best, z)

    compiling = _compiling(told, "search", start)
    every, programs = problem.train, problem.programs
    loss = lambda z: problem.at(z)[1]  # noqa: E731 - refinement needs this program anyway
    return search(problem.losses, start, problem.config, every, advance, programs, compiling, loss)


def _refine(problem: Problem, starts: np.ndarray, told: Told | None) -> Refined:
    total = _ROUNDS + len(starts) - 1

    def advance(best: float, z: np.ndarray) -> None:
        if told:
            told("refine", 1 / total, best, z)

    compiling = _compiling(told, "refine", starts[0])
    return refine(problem, starts, problem.config.refine_steps, _ROUNDS, advance, None, compiling)


def _compiling(told: Told | None, then: str, z: np.ndarray) -> Callable[[bool], None]:
    """Return what tells of programs that are compiled, before the phase ``then`` goes on."""
    return lambda on: told("compiling" if on else then, 0.0, float("inf"), z) if told else None
