"""Errors of an identification on later logs, beside those of the baselines and the promised ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import HeldOut, Identification
from sim2real.artifacts.recording import Recording
from sim2real.errors import UsageError
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, check_log
from sim2real.identify.validation import prediction
from sim2real.identify.validation.folds import moving
from sim2real.identify.validation.verdict import errors_of, positions, scores
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.fitted_logs import require_new
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import progress
from sim2real.stages.validate.config import ValidateConfig
from sim2real.stages.validate.result import FREE_RUN, MAX_ERROR_RATIO
from sim2real.types import Json


def score(
    identification: Identification, pipeline: Pipeline, logs: Sequence[Recording], config: ValidateConfig
) -> dict[str, Json]:
    """Return the errors on logs that were not fitted, as JSON.

    Raises:
        UsageError: A log was fitted; or each recording has its own parameters, which a later log lacks.
    """
    # Check that the identification has all parameters of the model, and that the logs are later ones.
    robot = held_out_parts.having(pipeline.load(), [p.name for p in identification.parameters])
    fitting = replace(pipeline.identify, settle_s=identification.settle_s)
    model = robot.identifiable(fitting.max_delay_s)
    if varying := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise UsageError(f"{', '.join(varying)} differ from recording to recording: a new log has no estimates of them")
    episodes = [log.episode for log in logs]
    for episode in episodes:
        check_log(episode, model)
    fitted = require_new(identification, logs, model, config.force)
    estimates = {p.name: p.estimate for p in identification.parameters}
    if lacking := [p.name for p in model.parameters if p.name not in estimates]:
        raise UsageError(f"the parameters lack {', '.join(lacking)}", hint="they are of another state of the robot")
    models = {
        "identified": {p.name: estimates[p.name] for p in model.parameters},
        "nominal": {p.name: p.nominal for p in model.parameters},
    }

    # Simulate windows of the promise's horizon, and free runs from one initial state a log.
    horizon_s = config.horizon_s or next((row.horizon_s for row in identification.held_out), fitting.horizon_s)
    shortest_s = min(end - begin for begin, end in (reach(e, fitting) for e in episodes))
    with progress(None, "validate: simulate"):
        windows = _problem(model, logs, fitting, min(horizon_s, shortest_s - fitting.settle_s))
        columns = prediction.samples(windows, models, fitting.settle_s)
        errors = prediction.errors(windows, columns, list(models), fitting.settle_s, [horizon_s])
        held_out = scores(errors, positions(model, robot.units))
        moves = dict(zip(prediction.labels(windows), moving(windows, np.arange(windows.segments)), strict=True))
        whole = _problem(model, logs, fitting, min(config.free_run_s, shortest_s) - fitting.settle_s, once=True)
        columns = prediction.samples(whole, models, fitting.settle_s)
        free_runs = prediction.free_runs(columns, prediction.labels(whole), list(models), fitting.settle_s)

    # Compare each position with the promise, unless its joint does not move.
    promised = {row.column: row.rmse.get("identified") for row in identification.held_out}
    promised |= held_out_parts.promises(identification.left_out)
    rows = {}
    for s in held_out:
        runs = [r for r in free_runs if r.field == s.column and r.model == "identified"]
        free_run = float(np.mean([np.inf if r.rmse is None else r.rmse for r in runs]))
        moved = moves[s.column]
        rows[s.name] = position_row(s, promised.get(s.column) if moved else None, free_run, moved)
    if not any(row["moves"] for row in rows.values()):
        raise UsageError("no joint moves in this log, so it tests no parameter", hint="take a log of motion")
    ratios = [r["over_promised"] for r in rows.values() if r["over_promised"] is not None]
    return {
        "pipeline": pipeline.name,
        "identified": identification.verdict.status,
        "why": list(identification.verdict.reasons),
        "fitted": fitted,
        "horizon_s": horizon_s,
        "positions": rows,
        "better": not any(row["beaten_by"] for row in rows.values()),
        "promise_kept": all(ratio <= MAX_ERROR_RATIO for ratio in ratios) if ratios else None,
        "rmse": float(np.sqrt(np.mean([errors_of(s)["identified"] ** 2 for s in held_out]))),
        "free_run_rmse": float(np.sqrt(np.mean([r[FREE_RUN] ** 2 for r in rows.values()]))),
    }


def position_row(s: HeldOut, promised: float | None, free_run: float, moves: bool) -> dict[str, Json]:
    """Return the row of a position.

    A joint that does not move is not compared with the baselines: "no motion" would always be best.
    """
    return {
        "moves": moves,
        "unit": s.unit,
        "rmse": errors_of(s),
        "beaten_by": list(s.beaten_by) if moves else [],
        "promised": promised,
        "over_promised": errors_of(s)["identified"] / promised if promised else None,
        FREE_RUN: free_run,
    }


def _problem(
    model: IdentifiableModel, logs: Sequence[Recording], config: IdentifyConfig, horizon_s: float, once: bool = False
) -> Problem:
    """Return logs in segments without a fitted one; ``once``: one segment a log."""
    length_s = config.settle_s + horizon_s
    spans = []
    for r, log in enumerate(logs):
        begin, end = reach(log.episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b), False) for b in (begins[:1] if once else begins)]
    return Problem(model, [log.episode for log in logs], spans, length_s, config)
