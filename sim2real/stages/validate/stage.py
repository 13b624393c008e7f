"""Score what was identified on later logs: held-out figures, in the terms of the verdict."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.identification import HeldOut, Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.manifest import plain
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, check_log
from sim2real.identify.validation import prediction
from sim2real.identify.validation.folds import moving
from sim2real.identify.validation.verdict import errors_of, positions, scores
from sim2real.log.importing.mapping import load_mapping
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.fitted_logs import require_new
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline import from_model, python_arguments
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.pipeline.python_arguments import (
    AnyIdentification,
    AnyRecording,
    config_of,
    identification_of,
    recordings_of,
)
from sim2real.stages.terminal.console import note, progress, shown, table
from sim2real.stages.validate.config import ValidateConfig

_PARAMETERS = "parameters.json"
_KEPT = 1.25
"""Up to this many times the error that the identification promised, the promise is kept."""
_FREE = "free run"
_ACCEPTED = "accepted"


def run(config: ValidateConfig) -> bool:
    """Score and print.

    Returns:
        Whether every position is predicted better than by every baseline.

    Raises:
        UsageError: When there are no parameters, no log, or a log was fitted.
    """
    if config.parameters is None or not config.log:
        raise UsageError(
            "validate needs parameters and a log", hint="sim2real validate RUN/identify/parameters.json --log new.mcap"
        )
    found = Identification.load(config.parameters)
    pipeline = pipeline_of(config.parameters, found, config)
    logs = [open_recording(Path(path), pipeline) for path in config.log]
    result = score(found, pipeline, logs, config)
    result = {"parameters": shown(config.parameters), "logs": list(config.log), **result}
    print(json.dumps(plain(result), indent=1)) if config.json else show(result)
    return bool(result["better"])


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Errors on logs that nothing was fitted to.

    Attributes:
        pipeline: The robot.
        horizon_s: How far ahead is predicted [s].
        positions: Position -> its errors, the baselines that beat it, what was promised.
        better: Whether every position is predicted better than by every baseline.
        promise_kept: Whether the promised errors were kept; None where none was made.
        rmse: Root mean square error of all positions at the horizon.
        free_run_rmse: The same in free runs.
        identified: The verdict of the identification.
        why: Its reasons.
        fitted: Sentences about logs that were fitted, which are no test.
    """

    pipeline: str
    horizon_s: float
    positions: dict[str, dict[str, Any]]
    better: bool
    promise_kept: bool | None
    rmse: float
    free_run_rmse: float
    identified: str = _ACCEPTED
    why: Sequence[str] = ()
    fitted: Sequence[str] = ()

    def about(self) -> dict[str, Any]:
        """Return what to say about it: name -> value."""
        kept = {None: "none was made", True: "yes", False: "no"}[self.promise_kept]
        found = {
            "pipeline": self.pipeline,
            "identification": self.identified,
            "better than baselines": "yes" if self.better else "no",
        }
        found |= {"fitted": "; ".join(self.fitted)} if self.fitted else {}
        return found | {"promise kept": kept, f"rmse {self.horizon_s:g} s ahead": self.rmse}

    def rows(self) -> ArtifactTable:
        """Return a row for each position."""
        own = [
            [name, row["rmse"]["identified"], row["promised"], row[_FREE], row["unit"]]
            for name, row in self.positions.items()
        ]
        return ArtifactTable(("position", "off", "promised", _FREE, "unit"), own)


def validate(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    recording: AnyRecording | Sequence[AnyRecording],
    config: ValidateConfig | Mapping[str, Any] | None = None,
) -> Validation:
    """Score what was identified on later recordings.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: What was identified, or its folder.
        recording: One recording that nothing was fitted to, or several; or the paths of their logs.
        config: How far ahead. A dict has what is different from the default.
    """
    pipeline, found = python_arguments.pipeline_of(robot), identification_of(identification)
    if found.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {found.pipeline!r}, not of {pipeline.name!r}")
    logs = recordings_of(recording, pipeline)
    return Validation(**score(found, pipeline, logs, config_of(config, ValidateConfig())))


def pipeline_of(path: Path, found: Identification, config: ValidateConfig) -> Pipeline:
    """Return the robot that parameters are of: described beside them, or a pipeline."""
    own = from_model.pipeline_beside(path, found)
    if not isinstance(own, from_model.DescribedPipeline):
        return own
    return own.reading(config.log, load_mapping(config.mapping, own.name) if config.mapping else None)


def score(
    found: Identification, pipeline: Pipeline, logs: Sequence[Recording], config: ValidateConfig
) -> dict[str, Any]:
    """Return errors on logs that nothing was fitted to, as JSON takes them.

    Raises:
        UsageError: When a log was fitted, or each recording has parameters of its own: of a new one they are not known.
    """
    robot = held_out_parts.having(pipeline.load(), [p.name for p in found.parameters])
    fitting = replace(pipeline.identify, settle_s=found.settle_s)
    model = robot.identifiable(fitting.max_delay_s)
    if own := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise UsageError(f"{', '.join(own)} differ from recording to recording: of a new log they are not known")
    episodes = [log.episode for log in logs]
    for episode in episodes:
        check_log(episode, model)
    fitted = require_new(found, logs, model, config.force)
    known = {p.name: p.estimate for p in found.parameters}
    if lacking := [p.name for p in model.parameters if p.name not in known]:
        raise UsageError(f"the parameters lack {', '.join(lacking)}", hint="they are of another state of the robot")
    values = {p.name: known[p.name] for p in model.parameters}
    models = {"identified": values, "nominal": {p.name: p.nominal for p in model.parameters}}
    promised = {row.column: row.rmse.get("identified") for row in found.held_out} | held_out_parts.promises(
        found.left_out
    )
    horizon_s = config.horizon_s or next((row.horizon_s for row in found.held_out), fitting.horizon_s)
    shortest_s = min(end - begin for begin, end in (reach(e, fitting) for e in episodes))
    rows = {}
    with progress(None, "validate: simulate"):
        windows = _problem(model, episodes, fitting, min(horizon_s, shortest_s - fitting.settle_s))
        columns = prediction.samples(windows, models, fitting.settle_s)
        errors = prediction.errors(windows, columns, list(models), fitting.settle_s, [horizon_s])
        judged = scores(errors, positions(model, robot.units))
        moves = dict(zip(prediction.labels(windows), moving(windows, np.arange(windows.segments)), strict=True))
        whole = _problem(model, episodes, fitting, min(config.free_run_s, shortest_s) - fitting.settle_s, once=True)
        columns = prediction.samples(whole, models, fitting.settle_s)
        free = prediction.free_runs(columns, prediction.labels(whole), list(models), fitting.settle_s)
    for s in judged:
        at = [np.inf if r.rmse is None else r.rmse for r in free if r.field == s.column and r.model == "identified"]
        own = moves[s.column]
        rows[s.name] = _row(s, promised.get(s.column) if own else None, float(np.mean(at)), own)
    if not any(row["moves"] for row in rows.values()):
        raise UsageError("no joint moves in this log: it tells nothing", hint="take a log of motion")
    kept = [r["over_promised"] for r in rows.values() if r["over_promised"] is not None]
    return {
        "pipeline": pipeline.name,
        "identified": found.verdict.status,
        "why": list(found.verdict.reasons),
        "fitted": fitted,
        "horizon_s": horizon_s,
        "positions": rows,
        "better": not any(row["beaten_by"] for row in rows.values()),
        "promise_kept": all(k <= _KEPT for k in kept) if kept else None,
        "rmse": float(np.sqrt(np.mean([errors_of(s)["identified"] ** 2 for s in judged]))),
        "free_run_rmse": float(np.sqrt(np.mean([r[_FREE] ** 2 for r in rows.values()]))),
    }


def show(result: dict[str, Any]) -> None:
    """Print a score, for people."""
    models = list(dict.fromkeys(m for row in result["positions"].values() for m in row["rmse"]))
    cells = [
        [name, *(row["rmse"].get(m) for m in models), row["promised"], row[_FREE], row["unit"]]
        for name, row in result["positions"].items()
    ]
    print(table(cells, [f"off {result['horizon_s']:g} s ahead", *models, "promised", _FREE, "unit"]))
    print(
        f"all positions: {result['rmse']:.4g} {result['horizon_s']:g} s ahead, "
        f"{result['free_run_rmse']:.4g} in free runs"
    )
    if resting := [name for name, row in result["positions"].items() if not row["moves"]]:
        note(f"{', '.join(resting)} did not move here, which neither keeps a promise nor breaks one")
    if not result["better"]:
        beaten = {n: row["beaten_by"] for n, row in result["positions"].items() if row["beaten_by"]}
        listed = "; ".join(f"{n} by {', '.join(by)}" for n, by in list(beaten.items())[:3])
        note(f"verdict: no improvement on this log: beaten are {listed}")
    elif result["promise_kept"] is False:
        note(f"verdict: better than the baselines, but more than {_KEPT:g} times as far off as was promised")
    elif result["fitted"]:
        note("verdict: none: a log that was fitted is no test")
    else:
        note("verdict: holds on this log")
    if result["identified"] != _ACCEPTED:
        note(f"the identification itself was not accepted: {result['identified']}: {'; '.join(result['why'][:1])}")


def _row(s: HeldOut, promised: float | None, free_run: float, moves: bool) -> dict[str, Any]:
    """Return the row of a position; one that rests is beaten by nobody, for that it rests is no prediction."""
    return {
        "moves": moves,
        "unit": s.unit,
        "rmse": errors_of(s),
        "beaten_by": list(s.beaten_by) if moves else [],
        "promised": promised,
        "over_promised": errors_of(s)["identified"] / promised if promised else None,
        _FREE: free_run,
    }


def _problem(
    model: IdentifiableModel, episodes: Sequence[Episode], config: IdentifyConfig, horizon_s: float, once: bool = False
) -> Problem:
    """Return logs in segments of which none is fitted; ``once``: one segment a log."""
    length_s = config.settle_s + horizon_s
    spans = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b), False) for b in (begins[:1] if once else begins)]
    return Problem(model, list(episodes), spans, length_s, config)
