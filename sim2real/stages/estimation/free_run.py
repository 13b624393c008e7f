"""Free runs on held-out data: their error as a share of the range of the motion, and a term that reduces it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import FreeRun, Identification
from sim2real.graph.episode import Episode
from sim2real.identify.fit import Fit, OnProgress, fit
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.validation import prediction
from sim2real.identify.validation.replays import replays
from sim2real.identify.validation.verdict import Position
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.segment_split import long_spans, reach, split_of
from sim2real.stages.identify.config import IdentifyConfig

TERM = "direction"
"""A constant force, or friction that differs by direction: the term that models lack most often."""
_FAR = 0.1
"""Error of a free run, as a share of the position's range, above which the term is tried."""
MENDS = 0.5
"""The model lacks the term if the error with it is below this share."""


@dataclass(frozen=True)
class Lack:
    """Result of the free runs: sentences, and flags with which to identify again; "" if no term reduces the error."""

    reasons: tuple[str, ...] = ()
    flags: str = ""


def free_runs(
    estimate: Fit,
    episodes: Sequence[Episode],
    fitted: int,
    config: IdentifyConfig,
    models: Mapping[str, Any],
) -> tuple[list[FreeRun], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Simulate the held-out part of each log in one run; return its errors, its columns, and its commands and starts.

    Args:
        fitted: Number of fitted logs; the later ones are held out whole.
        models: Model -> values of all parameters.
    """
    splits = [split_of(episode, r < fitted, config) for r, episode in enumerate(episodes)]
    ends = [reach(episode, config)[1] for episode in episodes]
    least_s = config.settle_s + config.horizon_s
    # Take the held-out part of each log that is long enough, each to its own end.
    held_out = [Span(r, split, False) for r, split in enumerate(splits) if ends[r] - split > least_s]
    if not held_out or not config.free_run_s:
        return [], {}, {}
    lengths_s = [min(config.free_run_s, ends[s.recording] - s.begin_s) for s in held_out]
    problem = estimate.windows.recut(held_out, max(lengths_s), ends_s=lengths_s)
    columns = prediction.samples(problem, models, config.settle_s)
    rows = prediction.free_runs(columns, prediction.labels(problem), list(models), config.settle_s)
    return rows, columns, replays(problem, estimate.values, config.settle_s, "free")


def fitted_to(
    model: IdentifiableModel,
    episodes: Sequence[Episode],
    fitted: int,
    windows: Sequence[Span],
    config: IdentifyConfig,
    table: ParameterTable,
    report: OnProgress | None = None,
    on_begin: Callable[[Problem], None] | None = None,
    as_start: bool = False,
    end: np.ndarray | None = None,
) -> Fit:
    """Return the fit of a model to logs.

    Args:
        windows: Segments to fit, and segments to predict.
        as_start: Whether it only has to be a start for fits with some of the optional terms.
        end: Where a fit of nearly this model ended, as in ``fit``.
    """
    longer, length_s = long_spans(episodes, fitted, config), config.settle_s + config.horizon_s
    return fit(model, list(episodes), windows, length_s, config, table, longer, report, on_begin, as_start, end)


def far_off(document: Identification, positions: Sequence[Position]) -> list[tuple[Position, float, float]]:
    """Return positions with the error of their free runs and its share of their range, the largest share first."""
    rows = []
    for p in positions:
        errors = [number(r.rmse) for r in document.free_run if _is(r, p) and r.model == "identified"]
        if errors:
            error = float(np.mean(errors)) if np.all(np.isfinite(errors)) else math.inf
            rows.append((p, error, error / max(float(np.ptp(document.samples[f"{p.column}_measured"])), 1e-300)))
    return sorted(rows, key=lambda row: -row[2])


def lacking(
    document: Identification,
    positions: Sequence[Position],
    attempt: Callable[[], Sequence[FreeRun]] | None,
    term: str = TERM,
) -> Lack:
    """Return the result of the free runs; if their error is large, the model is fitted with one further term.

    Args:
        attempt: Fits the model with the term and returns its free runs; None if the robot has no such term.
    """
    rows = far_off(document, positions)
    if not rows:
        return Lack()
    # Describe the worst position.
    worst, error, share = rows[0]
    seconds = max(r.seconds for r in document.free_run if _is(r, worst))
    unit = f" {worst.unit}".rstrip()
    result = f"is off by {error:.2g}{unit}, {share:.1%} of its range" if math.isfinite(error) else "diverges"
    message = f"in free runs of {seconds:.3g} s on held-out data {worst.name} {result}"
    if share <= _FAR or attempt is None:
        return Lack((message,))
    # Fit with the further term, and compare the errors of the worst position.
    errors = [number(r.rmse) for r in attempt() if _is(r, worst) and r.model == "identified"]
    mended = float(np.mean(errors)) if errors else math.inf
    if not mended < MENDS * error:
        return Lack((message, f"the term {term} does not mend that"))
    such = ", such as a constant force," if term == TERM else ""
    why = f"with the term {term}{such} it would be off by {mended:.2g}{unit}: the model lacks it"
    return Lack((message, why), f"--terms {','.join([*(document.terms or ()), term])}")


def with_one_more(
    robot: RecordedRobot, terms: Sequence[str] | None, config: IdentifyConfig, term: str = TERM
) -> tuple[RecordedRobot, IdentifyConfig] | None:
    """Return the robot and the configuration to fit it with a further term; None if it is chosen already, or held.

    Args:
        terms: The identified terms; None if the model has none.
    """
    if config.terms == "auto" or term in (terms or ()):
        return None
    wider = held_out_parts.offering(robot, wanted := ",".join([*(terms or ()), term]))
    table = wider.identifiable(config.max_delay_s).parameters
    held = {p.name for p in table if p.term == term} <= set(config.fix)
    return None if held else (wider, replace(config, terms=wanted, generations=0))


def _is(row: FreeRun, position: Position) -> bool:
    return row.field == position.column and row.held_out
