"""Scores an identification on later logs: for each joint the error, the expected error, and their ratio."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import plain, to_json
from sim2real.artifacts.identification import (
    ComparedError,
    Identification,
    compared_table,
)
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification import predictions as prediction
from sim2real.identification.expected import wider_for
from sim2real.identification.held_out import moving
from sim2real.identification.model import IdentifiableModel, measured_channels
from sim2real.identification.predictions import positions
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import check_log, extents
from sim2real.identification.verdict import ACCEPTED
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.load import AnyRobot, defaults_of, load_robot, robot_of
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import AnyIdentification, AnyRecording, open_recording
from sim2real.stages.shared.find_run import find_parameters
from sim2real.stages.shared.identification import command, identified_robot, side_by_side, usable, was_fitted
from sim2real.stages.terminal.console import artifact_table, note, progress
from sim2real.stages.validate.config import ValidateConfig
from sim2real.types import Json

_FREE_RUN_S = 10.0
"""Longest free run, if the identification has no expected error of free runs [s]."""
_LEAST_S = 0.2
"""Shortest prediction [s]."""
_NEIGHBOURS = 4
"""Number of models within the uncertainty, whose free runs show whether a free run is a test."""
_SHOWN = 12
"""Number of rows that the console prints, with the largest ratio first; ``--json`` has all."""


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Errors of an identification on logs that were not fitted.

    Attributes:
        errors: For each log and each joint that moves there, ahead and in a free run; the largest ratio first.
        identified: The status of the identification.
        resting: Log -> joints that do not move in it.
        unsteady: Log -> joints whose free run is not judged, because parameters within their uncertainty change it by
            more than the expected error, as for a balanced pendulum.
        refused: Log -> why it was not scored.
    """

    pipeline: str
    horizon_s: float
    errors: tuple[ComparedError, ...]
    identified: str = ACCEPTED
    resting: Mapping[str, Sequence[str]] = field(default_factory=dict)
    unsteady: Mapping[str, Sequence[str]] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def exceeded(self) -> tuple[ComparedError, ...]:
        """The errors above their expected errors."""
        return tuple(e for e in self.errors if e.exceeded)

    @property
    def beaten(self) -> tuple[ComparedError, ...]:
        """The errors with a baseline that is as good."""
        return tuple(e for e in self.errors if e.as_good)

    @property
    def holds(self) -> bool:
        """Whether each log was scored, no baseline is as good, and no error is above the expected one."""
        return not (self.refused or self.beaten or self.exceeded)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        logs = len({e.log for e in self.errors})
        which = "this log" if logs == 1 else f"these {logs} logs"
        if self.beaten:
            worst = self.beaten[0]
            return f"no improvement on {worst.log}: {worst.joint} is predicted as well by {', '.join(worst.as_good)}"
        if self.exceeded:
            further = len(self.exceeded) - 1
            rest = f" ({further} more of {len(self.errors)} errors are above)" if further else ""
            return f"worse than expected: {self.exceeded[0]}{rest}"
        if self.refused:
            return f"none of {', '.join(self.refused)}; holds on {which}"
        if any(e.expected is None for e in self.errors):
            return f"better than the baselines on {which}; the identification names no expected error for it"
        return f"holds on {which}"

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        facts = {"pipeline": self.pipeline, "identification": self.identified, "verdict": self.verdict}
        return facts | ({"not scored": ", ".join(self.refused)} if self.refused else {})

    def rows(self) -> ArtifactTable:
        """Return a row for each error, with the errors of baselines if windows are predicted."""
        return compared_table(self.errors)


def run(config: ValidateConfig) -> bool:
    """Score an identification and print the result.

    Returns:
        Whether it holds: each log was scored, no baseline is as good, and no error is above the expected one.

    Raises:
        UsageError: There are no parameters, or no log can be scored.
    """
    file = find_parameters(config.parameters, config.runs)
    identification = Identification.load(file)
    robot = load_robot(identification.pipeline)
    # A log that cannot be read is named, and the others are scored.
    logs, refused = [], dict[str, str]()
    for path in config.log:
        try:
            logs.append(open_recording(Path(path), robot))
        except Sim2RealError as error:
            if len(config.log) == 1:
                raise
            refused[path] = str(error)
    found = score(identification, robot, logs, refused)
    if config.json:
        rows = [{**plain(e), "ratio": e.ratio, "exceeded": e.exceeded} for e in found.errors]
        document = {**plain(found), "errors": rows, "verdict": found.verdict, "holds": found.holds}
        print(to_json(document).decode())
        return found.holds
    note(f"verdict: {found.verdict}")
    note(f"next: {_following(found, identification, robot, file.parent, config.log)}")
    print(artifact_table(found.rows(), _SHOWN))
    for log, joints in found.resting.items():
        note(f"{', '.join(joints)} does not move in {log}, which tests nothing about it")
    for log, joints in found.unsteady.items():
        note(f"no test of {', '.join(joints)}: free runs of {log} end far apart within the parameters' uncertainty")
    for log, reason in found.refused.items():
        note(f"not scored: {log}: {reason}")
    if found.identified != ACCEPTED:
        note(f"the identification itself was not accepted: {found.identified}")
    return found.holds


def _following(
    found: Validation, identification: Identification, robot: RecordedRobot, folder: Path, log: Sequence[str]
) -> str:
    """Return the next command, or a sentence on what to do."""
    if found.exceeded or found.beaten:
        # An identification from all logs covers the motion of the new logs.
        fitted = [os.path.relpath(folder.parent / source.path) for source in identification.logs]
        logs = tuple(dict.fromkeys([*fitted, *log]))
        again = command(robot, replace(defaults_of(robot).identify, log=logs), Path("runs"))
        return f"if the robot is still the same, identify from all of these logs: {again}"
    if found.identified != ACCEPTED:
        return identification.verdict.next or "identify again: this identification was not accepted"
    if found.refused:
        return "mend the logs that were not scored, or leave them out"
    if isinstance(robot, Robot):
        return f"sim2real train {robot.name} --run {shlex.quote(shown(folder.parent))}"
    return f"sim2real export {shlex.quote(shown(folder))}"


def validate(
    robot: AnyRobot,
    identification: AnyIdentification,
    recording: AnyRecording | Sequence[AnyRecording],
) -> Validation:
    """Score an identification on later recordings.

    Args:
        robot: The robot, or the name of its pipeline.
        identification: The identification, or its folder.
        recording: One recording that was not fitted, or several; or the paths of their logs.
    """
    robot = robot_of(robot)
    document = arguments.identification_of(identification)
    if document.pipeline != robot.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {robot.name!r}")
    logs = arguments.recordings_of(recording, robot)
    return score(document, robot, logs)


def score(
    identification: Identification,
    robot: RecordedRobot,
    logs: Sequence[Recording],
    refused: Mapping[str, str] | None = None,
) -> Validation:
    """Return the errors on logs that were not fitted, at the horizons of the expected errors.

    Args:
        refused: Log -> why it was not read.

    Raises:
        UsageError: No log can be scored: each was fitted, is too short, or lacks signals of the model.
    """
    robot, fitting = identified_robot(identification, robot)
    model = measured_channels(robot.identifiable(fitting.max_delay_s), [log.episode for log in logs])
    models = models_of(identification, model)
    refused = dict(refused or {})
    # Keep the logs that were not fitted, have the model's signals, and are long enough for a window.
    good, lengths = [], []
    for log, fitted in zip(logs, was_fitted(identification, logs, model), strict=True):
        try:
            if fitted:
                raise UsageError(f"{fitted}: errors there are no test of a fit")
            check_log(log.episode, model)
            begin, end = usable(log.episode, fitting)
            if end - begin - fitting.settle_s < _LEAST_S:
                raise UsageError(f"it lasts {log.episode.duration_s:.1f} s, too short for a prediction")
        except Sim2RealError as error:
            refused[str(log.path)] = str(error)
        else:
            good.append(log)
            lengths.append(end - begin - fitting.settle_s)
    if not good:
        raise UsageError("; ".join(f"{path}: {reason}" for path, reason in refused.items()) or "no log was given")

    # Predict windows as long as the horizon, and a free run of each log; a short log has shorter windows.
    horizon_s = next((row.seconds for row in identification.held_out), fitting.horizon_s)
    run_s = max((e.seconds for e in identification.expected_error if e.free_run), default=_FREE_RUN_S)
    errors, unsteady, measured = list[ComparedError](), dict[str, list[str]](), positions(model, robot.units)
    with progress(None, "validate: simulate"):
        windows = None
        for free_run, most_s in ((False, horizon_s), (True, run_s)):
            values = _neighbours(identification, models["identified"]) if free_run else models
            seconds = [min(most_s, length) for length in lengths]
            windows = _windows(model, good, seconds, fitting, free_run, windows)
            columns = prediction.samples(windows, values, fitting.settle_s)
            for r, log in enumerate(good):
                spans = [span for span in windows.spans if span.recording == r]
                seen = extents(model, [log.episode for log in good], spans, fitting.settle_s + seconds[r])
                wider = wider_for(identification.internal.motion, seen, measured)
                moves = moving(windows, np.flatnonzero(windows.recording == r))
                moves = dict(zip(prediction.labels(windows), moves, strict=True))
                moves = {p.name: moves[p.column] for p in measured}
                of_log = {name: column[columns["recording"] == r] for name, column in columns.items()}
                judged = ["identified"] if free_run else list(values)
                rows = prediction.errors(of_log, judged, measured, fitting.settle_s, seconds[r])
                for row in (row for row in rows if moves[row.joint]):
                    limit = identification.expected_of(row.joint, free_run)
                    expected = None if limit is None else wider.get(row.joint, 1.0) * limit.error
                    if free_run and expected is not None and not _spread(of_log, row.field, values) <= expected:
                        unsteady.setdefault(log.path.name, []).append(row.joint)
                        continue
                    found = replace(row, log=log.path.name, free_run=free_run, seconds=seconds[r], expected=expected)
                    errors.append(replace(found, as_good=(), baselines={}) if free_run else found)
    # Do not compare a resting joint: the baseline of standing still would always be best.
    moved = {(e.log, e.joint) for e in errors}
    resting = {log.path.name: [p.name for p in measured if (log.path.name, p.name) not in moved] for log in good}
    if not errors:
        raise UsageError("no joint moves in this log, so it tests no parameter", hint="take a log with motion")
    ordered = tuple(sorted(errors, key=lambda e: -(e.ratio or 0.0)))
    resting = {log: joints for log, joints in resting.items() if joints}
    status = identification.verdict.status
    return Validation(robot.name, horizon_s, ordered, status, resting, unsteady, refused)


def _neighbours(identification: Identification, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Return the identified model, and models drawn within its uncertainty."""
    models = {"identified": dict(values)}
    if (posterior := identification.posterior) is not None:
        drawn = posterior.sample(np.random.default_rng(0), _NEIGHBOURS)
        own = {n: rows for n, rows in drawn.items() if n in values}
        models |= {
            f"neighbour {k}": {**values, **{n: float(rows[k]) for n, rows in own.items()}} for k in range(_NEIGHBOURS)
        }
    return models


def _spread(columns: Mapping[str, np.ndarray], position: str, models: Mapping[str, object]) -> float:
    """Return how far neighbouring models move a joint from the identified model: the largest root mean square."""
    identified, *others = (columns[f"{position}_{name}"] for name in models)
    return max((float(np.sqrt(np.mean((other - identified) ** 2))) for other in others), default=0.0)


def models_of(identification: Identification, model: IdentifiableModel) -> dict[str, dict[str, float]]:
    """Return the values of the models that predict: identified and nominal.

    Raises:
        UsageError: The identification lacks parameters of the model.
    """
    estimates = {p.name: p.estimate for p in identification.parameters}
    if lacking := [p.name for p in model.parameters if p.name not in estimates]:
        raise UsageError(
            f"the parameters lack {', '.join(lacking)}",
            hint="identified with another version of this robot's model: identify again",
        )
    return {
        "identified": {p.name: estimates[p.name] for p in model.parameters},
        "nominal": {p.name: p.nominal for p in model.parameters},
    }


def _windows(
    model: IdentifiableModel,
    logs: Sequence[Recording],
    seconds: Sequence[float],
    config: IdentifyConfig,
    free_run: bool,
    like: Problem | None,
) -> Problem:
    """Return logs in held-out segments; for a free run, each log is one segment.

    Args:
        seconds: Length of the predictions of each log [s].
        like: Another problem of these logs; both share programs.
    """
    episodes, lengths_s = [log.episode for log in logs], [config.settle_s + own_s for own_s in seconds]
    spans = side_by_side(episodes, config, lengths_s, fitted=False)
    if free_run:
        spans = [next(s for s in spans if s.recording == r) for r in range(len(logs))]
    ends_s = [lengths_s[s.recording] for s in spans]
    like = like or Problem(model, episodes, spans, max(ends_s), config)
    return like.recut(spans, max(ends_s), ends_s=ends_s)
