"""A motion from a file as an excitation: a recorded, teleoperated or hand-guided one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import TICKS_PER_S
from sim2real.log.importing.importer import import_file
from sim2real.log.importing.propose import joint_motion
from sim2real.log.importing.readers import open_tables
from sim2real.log.reader import read_log
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.robot import Robot
from sim2real.stages.load import mapping_of

_LEAST_S = 1.0
"""Shortest motion [s]."""


@dataclass(frozen=True)
class FileMotion:
    """Commands over time.

    Attributes:
        t_s: Times ``(N,)``, increasing [s].
        commands: Shape ``(N, commands)`` [the command's unit].
        source: What of the file it is, for the user.
    """

    t_s: np.ndarray
    commands: np.ndarray
    source: str


def read_motion(path: Path, robot: Robot, names: Sequence[str]) -> FileMotion:
    """Return the motion in a file: goals if it has them, otherwise measured positions.

    A log of this robot, a file that the pipeline's ``import.toml`` maps, or any file that ``sim2real import`` reads
    whose columns have the names of the robot's joints.

    Args:
        names: The robot's commands.

    Raises:
        UsageError: The file has no such motion.
    """
    if not path.exists():
        raise UsageError(f"there is no motion {path}", hint="--excitation FILE is a log, or a csv, npz or parquet file")
    if path.suffix == ".mcap":
        motion = _of_log(path, robot)
    elif (mapping := mapping_of(robot, path)) is not None:
        episode = import_file(path, mapping)
        rows = episode.outputs[ACTUATOR][robot.drive.command]
        motion = FileMotion(episode.steps[ACTUATOR].begun_s, rows, f"{robot.drive.command} of {path.name}")
    else:
        motion = FileMotion(*joint_motion(open_tables(path)[0], names, robot.units[robot.drive.command]))
    return _whole(motion, path, len(names))


def _of_log(path: Path, robot: Robot) -> FileMotion:
    """Return the commands of a log; of one that was guided by hand the measured positions."""
    episode = read_log(path)
    sent = episode.outputs.get(ACTUATOR, {}).get(robot.drive.command)
    if sent is not None and len(sent):
        return FileMotion(episode.steps[ACTUATOR].end / TICKS_PER_S, sent, f"{robot.drive.command} of {path.name}")
    field = next((c.position for c in robot.sensor.channels if c.goal == robot.drive.command), None)
    measured = episode.outputs.get(SENSOR, {}).get(field or "")
    if measured is None:
        raise UsageError(
            f"{path} has no {robot.drive.command!r} of {ACTUATOR!r}",
            hint="is it a log of this robot? Measured positions are a motion only for position-controlled joints",
        )
    return FileMotion(episode.steps[SENSOR].begun_s, measured, f"{field} of {path.name}")


def _whole(motion: FileMotion, path: Path, commands: int) -> FileMotion:
    """Return a motion in the order of time, from time 0.

    Raises:
        UsageError: It is too short, or has another number of commands.
    """
    rows = np.asarray(motion.commands, np.float64).reshape(len(motion.commands), -1)
    if rows.shape[1] != commands:
        raise UsageError(f"{path} has {rows.shape[1]} commands for a robot with {commands}")
    later = np.flatnonzero(np.diff(motion.t_s, prepend=-np.inf) > 0)
    t_s, rows = motion.t_s[later], rows[later]
    if len(later) < 2 or t_s[-1] - t_s[0] < _LEAST_S:
        raise UsageError(f"the motion of {path} is shorter than {_LEAST_S:g} s")
    if not np.isfinite(rows).all():
        raise UsageError(f"the motion of {path} holds values that are no numbers")
    return FileMotion(t_s - t_s[0], rows, motion.source)
