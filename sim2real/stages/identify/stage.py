"""Identify dynamics, delays and initial states from recordings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sim2real.artifacts.identification import (
    PARAMETERS,
    ROUND_TRIP,
    Identification,
    compared_table,
    links_table,
    terms_table,
    with_small_unit,
)
from sim2real.artifacts.paths import shown
from sim2real.artifacts.run import OpenStage, StageFolder, open_stage
from sim2real.errors import UsageError
from sim2real.identification.uncertainty import noises
from sim2real.identification.verdict import advised
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.fitting import fit_model
from sim2real.stages.identify.inputs import Inputs, prepare
from sim2real.stages.identify.judgement import judge
from sim2real.stages.identify.progress import PARTIAL, Best, kept
from sim2real.stages.load import AnyRobot, defaults_of, robot_of
from sim2real.stages.shared.arguments import AnyRecording, config_of, open_recording, recordings_of
from sim2real.stages.shared.find_run import newest_recording
from sim2real.stages.shared.identification import command, continuing, identified_robot
from sim2real.stages.terminal.console import artifact_table, note, progress

_MOST_ROWS = 12
"""Most rows of a table of errors on the console: 120 logs would have 480."""


def identify(
    robot: AnyRobot,
    recording: AnyRecording | Sequence[AnyRecording],
    config: IdentifyConfig | Mapping[str, Any] | None = None,
    hold_out: AnyRecording | Sequence[AnyRecording] = (),
    best: Best | None = None,
    begin: Mapping[str, float] | None = None,
    standing: AnyRecording | None = None,
) -> Identification:
    """Identify a robot's parameters.

    Args:
        robot: The robot, or the name of its pipeline.
        recording: The recordings to fit: one or several, or the paths of their logs.
        config: Settings; default: the robot's. A dict has the settings that differ from these. Files in the settings
            are not read.
        hold_out: Recordings that are only predicted.
        best: Updated with the best values so far while the search runs.
        begin: Values at which the search begins; default: the model's.
        standing: The recording of a robot on its feet, from which its load is estimated.

    Returns:
        Estimates, their uncertainty, their predictions, and a verdict.

    Raises:
        UsageError: The recordings are too short, or do not fit the model.
        Sim2RealError: A recording has NaN in a field of the model, or other units.
    """
    robot = robot_of(robot)
    config = config_of(config, defaults_of(robot).identify)
    fitted = recordings_of(recording, robot)
    held_out = recordings_of(hold_out, robot, "hold_out") if hold_out else ()
    stands = recordings_of(standing, robot, "standing")[0] if standing is not None else None
    return _identify(prepare(robot, config, fitted, held_out, begin, stands), best or Best())


def _identify(inputs: Inputs, best: Best) -> Identification:
    # Fit, and store the fit before it is judged, which takes longer.
    fits = fit_model(inputs, best)
    best.fitted(fits.estimate.x, fits.estimate.loss)
    identification = judge(fits)
    return replace(
        identification,
        logs=inputs.sources(),
        units=inputs.units,
        noise=noises(identification.samples, inputs.units),
        timing=inputs.logs[0].timing,
    )


def run(robot: RecordedRobot, config: IdentifyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Identify the robot's parameters, in a stage folder.

    Args:
        run_dir: Run folder to add to; None: the log's.
    """
    paths, run_dir = find_logs(robot, config, root, run_dir)
    # Refuse wrong flags, logs that are given twice and logs that are too short before a folder is made.
    begin = _begin(config.begin, robot) if config.begin else None
    standing = Path(config.standing) if config.standing else None
    with progress(None, "identify: read the logs"):
        logs = [open_recording(path, robot) for path in paths]
        fitted = len(logs) - len(config.hold_out)
        stands = open_recording(standing, robot) if standing else None
        inputs = prepare(robot, config, logs[:fitted], logs[fitted:], begin, stands)
    files = {"log" if i == 0 else f"log_{i}": path for i, path in enumerate(paths)}
    files |= {"standing": standing} if standing else {}
    with (
        open_stage(root, robot.name, "identify", config, files, run_dir) as stage,
        kept(stage, inputs, continuing(robot, config, root, stage.folder / PARTIAL)) as best,
    ):
        identification = _identify(inputs, best)
        # Complete the verdict's flags to a command, and name the logs by their paths in the run folder.
        flags = identification.verdict.next
        again = command(robot, config, root, flags) if flags else _following(robot, stage, identification)
        if identification.verdict.status == "not finished":
            again = continuing(robot, config, root, stage.folder / PARAMETERS)
        verdict = replace(identification.verdict, next=again)
        identification = replace(identification, logs=inputs.sources(stage.run_dir), verdict=verdict)
        show(identification)
        _write(identification, stage, identified_robot(identification, robot)[0])
        stage.summary(summary(identification))
    return stage.result


def _write(identification: Identification, stage: OpenStage, robot: RecordedRobot) -> None:
    """Write the artifact, and the model as MJCF."""
    for name, path in identification.save(stage.folder).items():
        stage.output(name, path)
    if (exported := robot.exported(identification.values)) is not None:
        stage.output("mjcf", "identified.xml").write_text(exported.mjcf, encoding="utf-8")


def show(identification: Identification) -> None:
    """Print the verdict (whether to use the estimates, reasons, expected error, next command), then details."""
    verdict = identification.verdict
    note(f"verdict: {identification.headline}")
    for reason in verdict.reasons[:1]:
        note(f"reason: {reason}")
    note(f"expected error: {identification.outlook()}")
    note(f"next: {verdict.next}")
    print(artifact_table(identification.rows()))
    if identification.over_logs:
        print(artifact_table(identification.logs_table()))
    if identification.terms:
        print(artifact_table(terms_table(identification.terms)))
    if identification.errors:
        print(artifact_table(compared_table(identification.judged), _MOST_ROWS))
    if identification.links:
        print(artifact_table(links_table(identification.links)))
    if len(verdict.reasons) > 1:
        note("details:")
    for reason in verdict.reasons[1:]:
        note(f"  {reason}")
    if identification.worst is not None:
        note(f"  the worst second: {identification.worst}")


def summary(identification: Identification) -> dict[str, str]:
    """Return the lines that the console shows at the end: name -> text."""
    logs = identification.logs
    lines = {"log": logs[0].path if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0].path}"}
    if total := next((p for p in identification.parameters if p.name == ROUND_TRIP), None):
        lines["round trip delay"] = f"{1e3 * total.estimate:.1f} ms"
    for worst in identification.held_out[:1]:
        size = "diverges" if worst.error is None else with_small_unit(worst.error, worst.unit)
        joints = len(identification.held_out)
        which = f", the worst of {joints} joints" if joints > 1 else ""
        lines["error on held-out parts"] = f"{worst.joint} {size} {worst.seconds:.3g} s ahead{which}"
    lines["expected error"] = identification.outlook()
    lines["verdict"] = identification.verdict.status
    return lines


def _following(robot: RecordedRobot, stage: OpenStage, identification: Identification) -> str:
    """Return what to do if no flags of `identify` follow from the verdict."""
    name, folder, status = robot.name, shlex.quote(shown(stage.folder)), identification.verdict.status
    advice = advised(identification.verdict.reasons)
    first = f"{advice}, or " if advice else ""
    if status == "record again" and robot.folder is not None:
        return f"{first}sim2real check {name}, which says what motion determines the parameters"
    if status != "accepted" or robot.folder is None:
        return "look at the reason; no flag changes it" if status != "accepted" else advice
    if isinstance(robot, Robot):
        return f"{first}sim2real train {name} --run {shlex.quote(shown(stage.run_dir))}"
    return f"{first}sim2real validate {folder} --log LATER_LOG, or sim2real export {folder}"


def _begin(path: str, robot: RecordedRobot) -> dict[str, float]:
    """Return the values at which a search begins, from an earlier identification of the same robot."""
    earlier = Identification.load(Path(path))
    if earlier.pipeline != robot.name:
        raise UsageError(
            f"{path} is of pipeline {earlier.pipeline!r}, not of {robot.name!r}",
            hint="begin at an identification of the same robot, or leave --begin out",
        )
    return {p.name: p.estimate for p in earlier.parameters if p.kind != "derived" and p.state != "fixed"}


def find_logs(
    robot: RecordedRobot, config: IdentifyConfig, root: Path, run_dir: Path | None
) -> tuple[list[Path], Path | None]:
    """Return the logs, held-out ones at the end, and the run folder.

    Args:
        config: Has the logs; without logs, the newest finished recording is taken.
        run_dir: Run folder that is searched first.
    """
    held_out = [Path(p) for p in config.hold_out]
    if config.log:
        return [Path(p) for p in config.log] + held_out, run_dir
    recorded = newest_recording(robot, root, run_dir)
    return [*recorded.logs(), *held_out], run_dir or recorded.run_dir
