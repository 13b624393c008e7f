"""Errors of an identification on later logs, beside those of the baselines and the promised ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import AHEAD, FREE_RUN, HeldOut, Identification, Promise, too_many_broken
from sim2real.artifacts.recording import Recording
from sim2real.errors import UsageError
from sim2real.identify.problem.segments import check_log
from sim2real.identify.validation import prediction
from sim2real.identify.validation.draws import intervals
from sim2real.identify.validation.folds import moving
from sim2real.identify.validation.verdict import errors_of, positions, scores
from sim2real.stages.estimation import promises
from sim2real.stages.estimation.fitted_logs import require_new
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import progress
from sim2real.stages.validate.config import ValidateConfig
from sim2real.stages.validate.simulated import later_logs, models_of, predicted_logs
from sim2real.types import Json

_FREE_RUN_S = 10.0
"""Longest free run of an identification without a bound on free runs [s]."""


def score(
    identification: Identification, pipeline: Pipeline, logs: Sequence[Recording], config: ValidateConfig
) -> dict[str, Json]:
    """Return the errors on logs that were not fitted, as JSON.

    Raises:
        UsageError: A log was fitted; or each recording has its own parameters, which a later log lacks.
    """
    robot, model, fitting, models = models_of(identification, pipeline)
    episodes = [log.episode for log in logs]
    for episode in episodes:
        check_log(episode, model)
    fitted = require_new(identification, logs, model, config.force)

    # Simulate windows of the bounds' horizon, and free runs of their length from one initial state a log.
    bounds = promises.of(identification)
    horizon_s = config.horizon_s or next((row.horizon_s for row in identification.held_out), fitting.horizon_s)
    shortest_s = min(end - begin for begin, end in (reach(e, fitting) for e in episodes)) - fitting.settle_s
    run_s = config.free_run_s or max((b.seconds for b in bounds.values() if b.reach == FREE_RUN), default=_FREE_RUN_S)
    with progress(None, "validate: simulate"):
        windows = later_logs(model, logs, fitting, min(horizon_s, shortest_s))
        columns = prediction.samples(windows, models, fitting.settle_s)
        whole = later_logs(model, logs, fitting, min(run_s, shortest_s), once=True)
        runs = prediction.samples(whole, models, fitting.settle_s)
        bands, drawn = intervals(whole, runs, models["identified"], identification.posterior, fitting.settle_s)
    errors = prediction.errors(windows, columns, list(models), fitting.settle_s, [horizon_s])
    measured = positions(model, robot.units)
    held_out = scores(errors, measured)
    moves = dict(zip(prediction.labels(windows), moving(windows, np.arange(windows.segments)), strict=True))
    if not any(moves[s.column] for s in held_out):
        raise UsageError("no joint moves in this log, so it tests no parameter", hint="take a log of motion")

    # Compare each position of each log with its bound, unless its joint does not move.
    predicted, further = predicted_logs(identification, logs, windows, measured)
    document = replace(identification, samples=columns, free={**runs, **bands}, settle_s=fitting.settle_s)
    ledger = promises.on_later_logs(document, measured, predicted, bounds)
    rows = {s.name: position_row(s, ledger, moves[s.column]) for s in held_out}
    free_runs = [np.inf if row.error is None else row.error for row in ledger if row.reach == FREE_RUN]
    return {
        "pipeline": pipeline.name,
        "identified": identification.verdict.status,
        "why": list(identification.verdict.reasons),
        "fitted": fitted,
        "horizon_s": horizon_s,
        "positions": rows,
        "better": not any(row["beaten_by"] for row in rows.values()),
        "promise_kept": not too_many_broken(ledger) if any(row.bound for row in ledger) else None,
        "ledger": ledger,
        "drawn": [
            {"log": logs[k].path.name, "column": column, "low95": low, "high95": high}
            for (k, column), (low, high) in drawn.items()
            if moves[column]
        ],
        "beyond": further,
        "rmse": float(np.sqrt(np.mean([errors_of(s)["identified"] ** 2 for s in held_out]))),
        "free_run_rmse": float(np.sqrt(np.mean(np.square(free_runs)))),
    }


def position_row(s: HeldOut, ledger: Sequence[Promise], moves: bool) -> dict[str, Json]:
    """Return the row of a position; of several logs the worst errors.

    A joint that does not move is not compared with the baselines: "no motion" would always be best.
    """
    of = {reach: [r for r in ledger if r.column == s.column and r.reach == reach] for reach in (AHEAD, FREE_RUN)}
    worst = {
        reach: max(rows, key=lambda r: np.inf if r.error is None else r.error) for reach, rows in of.items() if rows
    }
    ratios = [r.ratio for rows in of.values() for r in rows if r.ratio is not None]
    return {
        "moves": moves,
        "unit": s.unit,
        "rmse": errors_of(s),
        "beaten_by": list(s.beaten_by) if moves else [],
        "promised": worst[AHEAD].bound if AHEAD in worst else None,
        "over_promised": max(ratios, default=None),
        FREE_RUN: worst[FREE_RUN].error if FREE_RUN in worst else None,
        f"promised, {FREE_RUN}": worst[FREE_RUN].bound if FREE_RUN in worst else None,
    }
