"""Logs that belong to a pipeline, opened for the stages that read them."""

from pathlib import Path

from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.identification.segments import require_moved
from sim2real.log.importing.importer import import_file
from sim2real.log.schema import unit_of
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.load import mapping_of
from sim2real.stages.terminal.console import note


def open_recording(path: Path, robot: RecordedRobot) -> Recording:
    """Read a log of a robot, in its units; a log that was cut is used as far as it goes.

    A file of another recorder is imported in memory, if the robot has a mapping for it.
    """
    # A file of another recorder is read by the pipeline's mapping.
    if (mapping := mapping_of(robot, path)) is not None:
        # A log of this package must be of this pipeline, and complete.
        recording = Recording(path, import_file(path, mapping))
        _require_fitting(recording, robot)
        return recording
    recording = Recording.load(path)
    for warning in recording.warnings:
        note(f"warning: {warning}; the readable part is used")
    owner = recording.pipeline
    if owner is None:
        raise Sim2RealError(f"{path} has no name of its pipeline: its metadata is damaged", hint="record again")
    if owner != robot.name:
        raise Sim2RealError(
            f"{path} is a log of pipeline {owner!r}, not of {robot.name!r}", hint=f"run `sim2real identify {owner}`"
        )
    require_moved(recording.episode, str(path))
    _require_fitting(recording, robot)
    holes = {n: m for n, m in (recording.episode.metadata["log"].get("missing_steps") or {}).items() if m}
    if holes:
        raise Sim2RealError(f"{path} lacks steps of {', '.join(holes)}: a part of it is damaged", hint="record again")
    return recording


def _require_fitting(recording: Recording, robot: RecordedRobot) -> None:
    require_units(recording, robot)
    for line in robot.doubts(recording.episode.outputs):
        note(f"warning: {recording.path.name}: {line}")


def require_units(recording: Recording, robot: RecordedRobot) -> None:
    """Check that what the robot's sensor and actuator sent is in the units that the robot computes in."""
    recorded_units = recording.episode.units or dict.fromkeys((SENSOR, ACTUATOR), recording.units)
    for node in (SENSOR, ACTUATOR):
        for field, unit in recorded_units.get(node, {}).items():
            if unit != (expected := unit_of(field, robot.units) or unit):
                raise Sim2RealError(
                    f"{field!r} of {node!r} is in {unit} in the log {recording.path}, the robot computes in {expected}",
                    hint="convert it: `scale` in the mapping of an import, or the robot's `units`",
                )
