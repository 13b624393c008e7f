"""The commands that a recording plays: a generated excitation, or a motion from a file within the robot's limits."""

import numpy as np

from sim2real.errors import UsageError
from sim2real.robots.robot import Robot
from sim2real.stages.excitation.motion_file import FileMotion, read_motion
from sim2real.stages.excitation.signals import excitation
from sim2real.stages.record.config import RecordConfig
from sim2real.stages.terminal.console import note

_ROUNDED = 1e-6
"""Excess over a limit that is a rounding error [the command's unit]."""


def played(config: RecordConfig, robot: Robot, announce: bool = False) -> np.ndarray:
    """Return the signal ``(N, commands)`` that ``RobotDrive.around`` makes commands of, one row a step.

    Args:
        announce: Whether it prints which signals of a file are played, and for how long.

    Raises:
        UsageError: The robot cannot play it: the frequencies are too high, or a motion leaves its limits.
    """
    commands = len(robot.agent.action)
    if config.standing:
        if (bent := robot.drive.standing(config.duration_s)) is None:
            raise UsageError("this robot does not stand on legs", hint="choose another --excitation")
        return bent
    if config.motion is None:
        return excitation(config, robot.rate_hz, commands).reshape(-1, commands)
    motion = read_motion(config.motion, robot, names_of(config, robot))
    rows = _within(_sampled(motion, robot.rate_hz, config.duration_s), config, robot)
    if announce:
        skipped_s = min(motion.t_s[-1], config.duration_s) - len(rows) / robot.rate_hz
        note(f"motion: {motion.source}, {len(rows) / robot.rate_hz:.1f} s")
        if skipped_s > 2.0 / robot.rate_hz:
            note(f"motion: {skipped_s:.1f} s at its ends are outside of the limits, and are not played")
    return rows - robot.drive.around(np.zeros((1, commands)))


def names_of(config: RecordConfig, robot: Robot) -> tuple[str, ...]:
    """Return the names of the robot's commands: its joints, otherwise their numbers."""
    count = len(robot.agent.action)
    names = robot.drive.gate(config.gate).joints
    return names if len(names) == count else tuple(f"{robot.drive.command}[{i}]" for i in range(count))


def _sampled(motion: FileMotion, rate_hz: float, duration_s: float) -> np.ndarray:
    """Return a motion at the robot's rate, ``(N, commands)``."""
    t_s = np.arange(0.0, min(motion.t_s[-1], duration_s), 1.0 / rate_hz)
    return np.stack([np.interp(t_s, motion.t_s, column) for column in motion.commands.T], axis=1)


def _within(rows: np.ndarray, config: RecordConfig, robot: Robot) -> np.ndarray:
    """Return the motion without its beginning and its end outside the limits, where an arm lies without torque.

    Raises:
        UsageError: It leaves the limits in between, or is too fast; the robot has not moved.
    """
    gate = robot.drive.gate(config.gate)
    low, high = (np.broadcast_to(np.asarray(end, np.float64), rows.shape[1]) for end in gate.range)
    low, high = low - _ROUNDED, high + _ROUNDED
    inside = np.flatnonzero(((rows >= low) & (rows <= high)).all(axis=1))
    if not inside.size:
        raise UsageError(
            f"{config.motion} is outside of the limits everywhere: {_worst(rows, low, high, config, robot)}"
        )
    rows = rows[inside[0] : inside[-1] + 1]
    if ((rows < low) | (rows > high)).any():
        raise UsageError(
            f"{config.motion} leaves the robot's limits: {_worst(rows, low, high, config, robot)}",
            hint="record it again within them; a limit is the smaller one of the robot's and --gate.limit",
        )
    speed, unit = np.abs(np.diff(rows, axis=0)) * robot.rate_hz, robot.units[robot.drive.command]
    most = np.inf if gate.slew_per_s is None else gate.slew_per_s
    if unit == "rad" and gate.max_speed_rad_s is not None:
        most = np.minimum(most, gate.max_speed_rad_s)
    most = np.broadcast_to(most, rows.shape[1])
    if (speed > most).any():
        row, column = np.unravel_index((speed - most).argmax(), speed.shape)
        name = names_of(config, robot)[column]
        raise UsageError(
            f"{config.motion} is too fast: {name} moves at {speed[row, column]:.3g} {unit}/s "
            f"at {row / robot.rate_hz:.2f} s, {most[column]:g} are allowed",
            hint="move slower; --gate.slew-per-s and --gate.max-speed-rad-s are the limits",
        )
    return rows


def _worst(rows: np.ndarray, low: np.ndarray, high: np.ndarray, config: RecordConfig, robot: Robot) -> str:
    """Return the command that is farthest beyond its limits."""
    beyond = np.maximum(low - rows, rows - high)
    row, column = np.unravel_index(beyond.argmax(), beyond.shape)
    name, value, unit = names_of(config, robot)[column], rows[row, column], robot.units[robot.drive.command]
    return (
        f"{name} is {value:.3g} {unit} at {row / robot.rate_hz:.2f} s, and must lie in "
        f"[{low[column]:.3g}, {high[column]:.3g}]"
    )
