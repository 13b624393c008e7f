"""Score an identification on later logs: for each joint the error, the expected error, and their ratio."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import plain, to_json
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identify.expected import wider_for
from sim2real.identify.model import IdentifiableModel, measured_channels
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, check_log, ranges
from sim2real.identify.validation import prediction
from sim2real.identify.validation.folds import moving
from sim2real.identify.validation.verdict import Position, positions, scores
from sim2real.log.importing.mapping import load_mapping
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.fitted_logs import require_new
from sim2real.stages.estimation.replay_problem import longest_delay_s
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline import from_model, python_arguments
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline, pipeline_of
from sim2real.stages.pipeline.python_arguments import AnyIdentification, AnyRecording
from sim2real.stages.terminal.console import artifact_table, note, progress
from sim2real.stages.validate.config import ValidateConfig
from sim2real.types import Json

ACCEPTED = "accepted"
AHEAD, FREE_RUN = "ahead", "free run"
MOST_ABOVE = 1.25
"""Largest ratio of an error to the expected error that is not called exceeded: few errors are above it by this much."""
_FREE_RUN_S = 10.0
"""Longest free run of an identification without an expected error of free runs [s]."""
_LEAST_S = 0.2
"""Shortest prediction [s]."""
_SHOWN = 12
"""Rows that the console prints, those with the largest ratio; ``--json`` has all."""


@dataclass(frozen=True)
class LaterError:
    """The error of one joint on one log, beside the expected one.

    Attributes:
        kind: ``ahead``: windows of a horizon, each from a state of its own; ``free run``: one run.
        seconds: The horizon, or the length of the run [s].
        error: Root mean square error; None if the model diverges.
        expected: None if the identification expects none.
        wider: Factor of ``expected`` for a motion that is faster or goes further than the fitted one.
        beaten_by: Baselines with an error that is not larger.
        baselines: Model -> its error; None if it diverges.
    """

    log: str
    joint: str
    unit: str
    kind: str
    seconds: float
    error: float | None
    expected: float | None = None
    wider: float = 1.0
    beaten_by: tuple[str, ...] = ()
    baselines: Mapping[str, float | None] | None = None

    @property
    def ratio(self) -> float | None:
        """The error over the expected error; None without one."""
        return None if self.expected is None else math.inf if self.error is None else self.error / self.expected

    @property
    def exceeded(self) -> bool:
        """Whether the error is above the expected one by more than ``MOST_ABOVE``."""
        return self.ratio is not None and self.ratio > MOST_ABOVE

    def __str__(self) -> str:
        """Return the error and the expected error as a sentence."""
        how = f"{self.seconds:.3g} s ahead" if self.kind == AHEAD else f"in a free run of {self.seconds:.3g} s"
        size = "diverges" if self.error is None else f"is off by {self.error:.2g} {self.unit}".rstrip()
        text = f"{self.joint} {size} {how} on {self.log}"
        if self.expected is None or self.ratio is None:
            return text
        times = "" if self.error is None else f": {self.ratio:.2f} times"
        return f"{text}; expected was {self.expected:.2g} {self.unit}".rstrip() + times


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Errors of an identification on logs that were not fitted.

    Attributes:
        errors: For each log and each joint that moves there, ahead and in a free run; the largest ratio first.
        identified: The status of the identification.
        resting: Log -> joints that do not move in it.
        refused: Log -> why it was not scored.
        fitted: Sentences about fitted logs, which test nothing.
    """

    pipeline: str
    horizon_s: float
    errors: tuple[LaterError, ...]
    identified: str = ACCEPTED
    resting: Mapping[str, Sequence[str]] | None = None
    refused: Mapping[str, str] | None = None
    fitted: Sequence[str] = ()

    @property
    def exceeded(self) -> tuple[LaterError, ...]:
        """The errors above their expected errors."""
        return tuple(e for e in self.errors if e.exceeded)

    @property
    def beaten(self) -> tuple[LaterError, ...]:
        """The errors that a baseline does not exceed."""
        return tuple(e for e in self.errors if e.beaten_by)

    @property
    def holds(self) -> bool:
        """Whether each log was scored, no baseline is as good, and no error is above the expected one."""
        return not (self.refused or self.beaten or self.exceeded)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        logs = len({e.log for e in self.errors})
        which = "this log" if logs == 1 else f"these {logs} logs"
        if self.fitted:
            return "none: a log that was fitted is no test"
        if self.beaten:
            worst = self.beaten[0]
            return f"no improvement on {worst.log}: {worst.joint} is predicted as well by {', '.join(worst.beaten_by)}"
        if self.exceeded:
            further = len(self.exceeded) - 1
            rest = f" ({further} more of {len(self.errors)} errors are above)" if further else ""
            return f"worse than expected: {self.exceeded[0]}{rest}"
        if self.refused:
            return f"none of {', '.join(self.refused)}; holds on {which}"
        if any(e.expected is None for e in self.errors):
            return f"better than the baselines on {which}; the identification expects no error for it"
        return f"holds on {which}"

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        facts = {"pipeline": self.pipeline, "identification": self.identified, "verdict": self.verdict}
        return facts | ({"not scored": ", ".join(self.refused)} if self.refused else {})

    def rows(self) -> ArtifactTable:
        """Return a row for each error, with those of the baselines where windows are predicted."""
        models = list(dict.fromkeys(m for e in self.errors for m in e.baselines or ()))
        cells = [
            [
                *(e.joint, e.log, f"{e.seconds:.3g} s {'ahead' if e.kind == AHEAD else e.kind}"),
                *(math.inf if e.error is None else e.error, e.expected),
                *("" if e.ratio is None else f"{e.ratio:.2f}", e.unit),
                *((e.baselines or {}).get(m, "") for m in models),
            ]
            for e in self.errors
        ]
        return ArtifactTable(("joint", "log", "predicted", "error", "expected", "ratio", "unit", *models), cells)


def run(config: ValidateConfig) -> bool:
    """Score an identification and print the result.

    Returns:
        Whether it holds: each log was scored, no baseline is as good, and no error is above the expected one.

    Raises:
        UsageError: There are no parameters or no log, or no log can be scored.
    """
    if config.parameters is None or not config.log:
        raise UsageError(
            "validate needs parameters and a log", hint="sim2real validate RUN/identify/parameters.json --log new.mcap"
        )
    identification = Identification.load(config.parameters)
    pipeline = from_model.pipeline_beside(config.parameters, identification)
    if isinstance(pipeline, from_model.DescribedPipeline) and (config.mapping or pipeline.mapping is None):
        mapping = load_mapping(config.mapping, pipeline.name).of_joints() if config.mapping else None
        pipeline = pipeline.reading(config.log, mapping)
    # A log that cannot be read is named, and the others are scored.
    logs, refused = [], dict[str, str]()
    for path in config.log:
        try:
            logs.append(open_recording(Path(path), pipeline))
        except Sim2RealError as error:
            if len(config.log) == 1:
                raise
            refused[path] = str(error)
    found = score(identification, pipeline, logs, config, refused)
    if config.json:
        rows = [{**plain(e), "ratio": e.ratio, "exceeded": e.exceeded} for e in found.errors]
        document = {**plain(found), "errors": rows, "verdict": found.verdict, "holds": found.holds}
        print(to_json(document).decode())
        return found.holds
    table = found.rows()
    print(artifact_table(ArtifactTable(table.headers, table.rows[:_SHOWN])))
    if more := table.rows[_SHOWN:]:
        note(f"and {len(more)} more rows with smaller ratios: --json has all")
    for log, joints in (found.resting or {}).items():
        note(f"{', '.join(joints)} does not move in {log}, which tests nothing about it")
    for log, reason in (found.refused or {}).items():
        note(f"not scored: {log}: {reason}")
    if found.identified != ACCEPTED:
        note(f"the identification itself was not accepted: {found.identified}")
    note(f"verdict: {found.verdict}")
    return found.holds


def validate(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    recording: AnyRecording | Sequence[AnyRecording],
    config: ValidateConfig | Mapping[str, Json] | None = None,
) -> Validation:
    """Score an identification on later recordings.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: The identification, or its folder.
        recording: One recording that was not fitted, or several; or the paths of their logs.
        config: A dict holds the fields that differ from the default.
    """
    pipeline = pipeline_of(robot)
    document = python_arguments.identification_of(identification)
    if document.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {pipeline.name!r}")
    logs = python_arguments.recordings_of(recording, pipeline)
    return score(document, pipeline, logs, python_arguments.config_of(config, ValidateConfig()))


def score(
    identification: Identification,
    pipeline: Pipeline,
    logs: Sequence[Recording],
    config: ValidateConfig,
    refused: Mapping[str, str] | None = None,
) -> Validation:
    """Return the errors on logs that were not fitted.

    Args:
        refused: Log -> why it was not read.

    Raises:
        UsageError: A log was fitted, no log can be scored, or each recording has its own parameters.
    """
    robot, fitting = identified_robot(identification, pipeline)
    model = measured_channels(robot.identifiable(fitting.max_delay_s), [log.episode for log in logs])
    models = models_of(identification, model)
    refused = dict(refused or {})
    fitted = require_new(identification, logs, model, config.force)
    # Keep the logs that hold the model's signals and are long enough for a window.
    good, lengths = [], []
    for log in logs:
        try:
            check_log(log.episode, model)
            begin, end = reach(log.episode, fitting)
            if end - begin - fitting.settle_s < _LEAST_S:
                raise UsageError(f"it lasts {log.episode.duration_s:.1f} s, too short for a prediction")
        except Sim2RealError as error:
            refused[str(log.path)] = str(error)
        else:
            good.append(log)
            lengths.append(end - begin - fitting.settle_s)
    if not good:
        raise UsageError("; ".join(f"{path}: {reason}" for path, reason in refused.items()) or "no log was given")

    # Predict windows of the horizon, and a free run of each log; a short log has shorter ones.
    expected = {(e.column, str(e.kind)): e for e in identification.expected_error}
    horizon_s = config.horizon_s or next((row.horizon_s for row in identification.held_out), fitting.horizon_s)
    run_s = config.free_run_s or max((b.seconds for k, b in expected.items() if k[1] == FREE_RUN), default=_FREE_RUN_S)
    errors, measured = list[LaterError](), positions(model, robot.units)
    with progress(None, "validate: simulate"):
        for kind, most_s, names in ((AHEAD, horizon_s, tuple(models)), (FREE_RUN, run_s, ("identified",))):
            values = {name: models[name] for name in names}
            for seconds in sorted({min(most_s, length) for length in lengths}):
                those = [r for r, length in enumerate(lengths) if min(most_s, length) == seconds]
                windows = _segments(model, good, those, fitting, seconds, kind == FREE_RUN)
                rows = _predicted(windows, values, measured, those, fitting.settle_s, kind, seconds)
                for r in those:
                    spans = [s for s in windows.spans if s.recording == r]
                    seen = ranges(model, [log.episode for log in good], spans, windows.segment_s)
                    wider = wider_for(identification.ranges, seen, measured)
                    for row in (row for log, row in rows if log == r):
                        bound, factor = expected.get((row.joint, kind)), wider.get(row.joint, 1.0)
                        limit = None if bound is None else factor * bound.error
                        errors.append(replace(row, log=good[r].path.name, expected=limit, wider=factor))
    # A joint that rests is not compared: "no motion" would always be best.
    moved = {(e.log, e.joint) for e in errors if e.kind == AHEAD}
    resting = {log.path.name: [p.name for p in measured if (log.path.name, p.column) not in moved] for log in good}
    if not errors:
        raise UsageError("no joint moves in this log, so it tests no parameter", hint="take a log of motion")
    named = {p.column: p.name for p in measured}
    errors = [replace(e, joint=named[e.joint]) for e in errors]
    ordered = tuple(sorted(errors, key=lambda e: -(e.ratio or 0.0)))
    resting = {log: joints for log, joints in resting.items() if joints}
    status = identification.verdict.status
    return Validation(pipeline.name, horizon_s, ordered, status, resting, refused, fitted)


def identified_robot(identification: Identification, pipeline: Pipeline) -> tuple[RecordedRobot, IdentifyConfig]:
    """Return the robot in the world of an identification, with its terms, and settings with its longest delay.

    Raises:
        UsageError: Its world is not installed.
    """
    names = [p.name for p in identification.parameters]
    robot = held_out_parts.having(in_world(pipeline.load(), identification.world), names)
    longest_s = longest_delay_s(robot, identification, pipeline.identify.max_delay_s)
    return robot, replace(pipeline.identify, settle_s=identification.settle_s, max_delay_s=longest_s)


def models_of(identification: Identification, model: IdentifiableModel) -> dict[str, dict[str, float]]:
    """Return the values of the models that predict: identified and nominal.

    Raises:
        UsageError: The identification lacks parameters of the model, or each recording has its own.
    """
    if varying := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise UsageError(f"{', '.join(varying)} differ from recording to recording: a new log has no estimates of them")
    estimates = {p.name: p.estimate for p in identification.parameters}
    if lacking := [p.name for p in model.parameters if p.name not in estimates]:
        raise UsageError(f"the parameters lack {', '.join(lacking)}", hint="they are of another state of the robot")
    return {
        "identified": {p.name: estimates[p.name] for p in model.parameters},
        "nominal": {p.name: p.nominal for p in model.parameters},
    }


def _segments(
    model: IdentifiableModel,
    logs: Sequence[Recording],
    those: Sequence[int],
    config: IdentifyConfig,
    seconds: float,
    once: bool,
) -> Problem:
    """Return some logs in segments without a fitted one; ``once``: one segment a log."""
    length_s, spans = config.settle_s + seconds, []
    for r in those:
        begin, end = reach(logs[r].episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b), False) for b in (begins[:1] if once else begins)]
    return Problem(model, [log.episode for log in logs], spans, length_s, config)


def _predicted(
    windows: Problem,
    models: Mapping[str, Mapping[str, float]],
    measured: Sequence[Position],
    those: Sequence[int],
    settle_s: float,
    kind: str,
    seconds: float,
) -> list[tuple[int, LaterError]]:
    """Return the number of each log, and the errors of its moving joints, which are named by their columns."""
    columns, rows = prediction.samples(windows, models, settle_s), []
    for r in those:
        segments = np.flatnonzero(windows.recording == r)
        moves = dict(zip(prediction.labels(windows), moving(windows, segments), strict=True))
        of_log = {name: values[columns["recording"] == r] for name, values in columns.items()}
        for s in scores(prediction.errors(windows, of_log, list(models), settle_s, [seconds]), measured):
            if moves[s.column]:
                others = {m: e for m, e in s.rmse.items() if m != "identified"} if kind == AHEAD else None
                beaten = s.beaten_by if kind == AHEAD else ()
                error = s.rmse["identified"]
                row = LaterError("", s.column, s.unit, kind, seconds, error, None, 1.0, beaten, others)
                rows.append((r, row))
    return rows
