"""Free runs over what was held out: how far they are off beside the range of the motion, and a term that mends them."""

from __future__ import annotations

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
from sim2real.identify.validation.verdict import Position
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.segment_split import reach, spans, split_of
from sim2real.stages.identify.config import IdentifyConfig

TERM = "direction"
"""A constant force, or friction that differs by direction: the term that a model lacks first."""
_FAR = 0.1
"""Share of a position's range by which a free run may be off before a term is tried."""
_MENDS = 0.5
"""Share of the error that is left with a term that the model lacks."""


@dataclass(frozen=True)
class Lack:
    """What free runs show.

    Attributes:
        reasons: Sentences.
        flags: Flags with which to identify again; "" where no term mends the free runs.
    """

    reasons: tuple[str, ...] = ()
    flags: str = ""


def free_runs(
    found: Fit, episodes: Sequence[Episode], fitted: int, config: IdentifyConfig, models: Mapping[str, Any]
) -> tuple[list[FreeRun], dict[str, np.ndarray]]:
    """Simulate what is held out of each log in one go; return its errors and its columns.

    Args:
        fitted: How many of them are fitted; the others are held out whole.
        models: Model -> values of all parameters.
    """
    splits = [split_of(episode, r < fitted, config) for r, episode in enumerate(episodes)]
    ends = [reach(episode, config)[1] for episode in episodes]
    least_s = config.settle_s + config.horizon_s
    held_out = [Span(r, split, False) for r, split in enumerate(splits) if ends[r] - split > least_s]
    if not held_out or not config.free_run_s:
        return [], {}
    length_s = min(config.free_run_s, min(ends[s.recording] - s.begin_s for s in held_out))
    problem = found.windows.recut(held_out, length_s)
    columns = prediction.samples(problem, models, config.settle_s)
    return prediction.free_runs(columns, prediction.labels(problem), list(models), config.settle_s), columns


def fitted_to(
    model: IdentifiableModel,
    episodes: Sequence[Episode],
    fitted: int,
    windows: Sequence[Span],
    config: IdentifyConfig,
    table: ParameterTable,
    report: OnProgress | None = None,
    begins: Callable[[Problem], None] | None = None,
) -> Fit:
    """Return the fit of a model to logs.

    Args:
        windows: Segments to search on, and others to predict.
    """
    longer = [s for s in spans(episodes, fitted, config, config.long_s) if s.fitted] if config.long_s else []
    return fit(
        model, list(episodes), windows, config.settle_s + config.horizon_s, config, table, longer, report, begins
    )


def far_off(document: Identification, positions: Sequence[Position]) -> list[tuple[Position, float, float]]:
    """Return positions with the error of their free runs and its share of their range, the largest share first."""
    rows = []
    for p in positions:
        own = [number(r.rmse) for r in document.free_run if _is(r, p) and r.model == "identified"]
        if own:
            error = float(np.mean(own)) if np.all(np.isfinite(own)) else math.inf
            rows.append((p, error, error / max(float(np.ptp(document.samples[f"{p.column}_measured"])), 1e-300)))
    return sorted(rows, key=lambda row: -row[2])


def lacking(
    document: Identification, positions: Sequence[Position], attempt: Callable[[], Sequence[FreeRun]] | None
) -> Lack:
    """Return what free runs show; where they are far off, the model is fitted with one more term.

    Args:
        attempt: Fits the model with ``TERM`` as well, and returns its free runs; None: the robot has no such term.
    """
    rows = far_off(document, positions)
    if not rows:
        return Lack()
    worst, error, share = rows[0]
    seconds = max(r.seconds for r in document.free_run if _is(r, worst))
    unit = f" {worst.unit}".rstrip()
    how = f"is off by {error:.2g}{unit}, {share:.1%} of its range" if math.isfinite(error) else "diverges"
    said = f"in free runs of {seconds:.3g} s on held-out data {worst.name} {how}"
    if share <= _FAR or attempt is None:
        return Lack((said,))
    again = [number(r.rmse) for r in attempt() if _is(r, worst) and r.model == "identified"]
    left = float(np.mean(again)) if again else math.inf
    if not left < _MENDS * error:
        return Lack((said, f"the term {TERM} does not mend that"))
    why = f"with the term {TERM}, such as a constant force, it would be off by {left:.2g}{unit}: the model lacks it"
    return Lack((said, why), f"--terms {','.join([*(document.terms or ()), TERM])}")


def with_one_more(
    robot: RecordedRobot, terms: Sequence[str] | None, config: IdentifyConfig
) -> tuple[RecordedRobot, IdentifyConfig] | None:
    """Return the robot and the settings to fit it with ``TERM`` as well; None where that is no choice.

    Args:
        robot: The robot, without optional terms that it may offer.
        terms: Those that were identified; None where it has none.
    """
    if config.terms == "auto" or TERM in (terms or ()):
        return None
    wider = held_out_parts.offering(robot, wanted := ",".join([*(terms or ()), TERM]))
    table = wider.identifiable(config.max_delay_s).parameters
    held = {p.name for p in table if p.term == TERM} <= set(config.fix)
    return None if held else (wider, replace(config, terms=wanted, generations=0))


def _is(row: FreeRun, position: Position) -> bool:
    return row.field == position.column and row.held_out
