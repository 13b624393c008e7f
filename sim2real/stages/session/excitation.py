"""The commands that a recording plays: a generated excitation, or a motion from a file within the robot's limits."""

from __future__ import annotations

from collections.abc import Sequence
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
from sim2real.robots.walking.drive import WalkingDrive
from sim2real.stages.load import mapping_of
from sim2real.stages.session.config import RecordConfig
from sim2real.stages.terminal.console import note

_ROUNDED = 1e-6
"""A smaller excess over a limit is a rounding error [the command's unit]."""
_LEAST_S = 1.0
"""Shortest motion [s]."""
_BEND_HZ = 0.3
"""How often a standing robot bends its legs [Hz]."""


def played(config: RecordConfig, robot: Robot, announce: bool = False) -> np.ndarray:
    """Return the signal ``(N, commands)`` around ``RobotDrive.centre``, with a row for each step.

    Args:
        announce: Whether to print which signals of a file are played, and for how long.

    Raises:
        UsageError: The robot cannot play it: the frequencies are too high, or a motion leaves its limits.
    """
    commands = len(robot.task.action)
    if config.standing:
        if not isinstance(robot.drive, WalkingDrive):
            raise UsageError("this robot does not stand on legs", hint="choose another --excitation")
        return bent_legs(robot.drive.crouch, config.duration_s, robot.drive.rate_hz)
    if config.motion is None:
        return excitation(config, robot.drive.rate_hz, commands).reshape(-1, commands)
    # The names of the robot's commands: its joints, otherwise their numbers.
    names = robot.drive.gate(config.gate).joints
    if len(names) != commands:
        names = tuple(f"{robot.drive.command}[{i}]" for i in range(commands))
    t_s, motion, source = _read_motion(config.motion, robot, names)
    steps_s = np.arange(0.0, min(t_s[-1], config.duration_s), 1.0 / robot.drive.rate_hz)
    sampled = np.stack([np.interp(steps_s, t_s, column) for column in motion.T], axis=1)
    rows = _within(sampled, config, robot, names)
    if announce:
        skipped_s = min(t_s[-1], config.duration_s) - len(rows) / robot.drive.rate_hz
        note(f"motion: {source}, {len(rows) / robot.drive.rate_hz:.1f} s")
        if skipped_s > 2.0 / robot.drive.rate_hz:
            note(f"motion: {skipped_s:.1f} s at its ends are outside of the limits, and are not played")
        gaps_s = np.diff(t_s)
        k = int(np.argmax(gaps_s))
        if gaps_s[k] > max(0.3, 5.0 * float(np.median(gaps_s))):
            note(f"warning: the file has no values from {t_s[k]:.1f} to {t_s[k + 1]:.1f} s: a straight line is played")
    return rows - robot.drive.centre


# -- a motion from a file


def _read_motion(path: Path, robot: Robot, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the motion in a file: goals if it has them, otherwise measured positions.

    The file is a log of this robot, a file for which the pipeline's ``import.toml`` is a mapping, or any file that
    ``sim2real import`` reads and whose columns have the names of the robot's joints.

    Args:
        names: Names of the robot's commands.

    Returns:
        Increasing times from 0 ``(N,)`` [s], commands ``(N, commands)`` [the command's unit], and a description.

    Raises:
        UsageError: The file has no such motion.
    """
    if not path.exists():
        raise UsageError(f"there is no motion {path}", hint="--excitation FILE is a log, or a csv, npz or parquet file")
    if path.suffix == ".mcap":
        t_s, rows, source = _of_log(path, robot)
    elif (mapping := mapping_of(robot, path)) is not None:
        episode = import_file(path, mapping)
        rows = episode.outputs[ACTUATOR][robot.drive.command]
        t_s, source = episode.steps[ACTUATOR].begun_s, f"{robot.drive.command} of {path.name}"
    else:
        t_s, rows, source = joint_motion(open_tables(path)[0], names, robot.units[robot.drive.command])
    rows = np.asarray(rows, np.float64).reshape(len(rows), -1)
    if rows.shape[1] != len(names):
        raise UsageError(f"{path} has {rows.shape[1]} commands for a robot with {len(names)}")
    later = np.flatnonzero(np.diff(t_s, prepend=-np.inf) > 0)
    t_s, rows = t_s[later], rows[later]
    if len(later) < 2 or t_s[-1] - t_s[0] < _LEAST_S:
        raise UsageError(f"the motion of {path} is shorter than {_LEAST_S:g} s")
    if not np.isfinite(rows).all():
        raise UsageError(f"the motion of {path} holds values that are no numbers")
    return t_s - t_s[0], rows, source


def _of_log(path: Path, robot: Robot) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the commands of a log, or the measured positions if it was guided by hand."""
    episode, field = read_log(path), robot.drive.command
    sent = episode.outputs.get(ACTUATOR, {}).get(field)
    if sent is not None and len(sent):
        return episode.steps[ACTUATOR].end / TICKS_PER_S, sent, f"{field} of {path.name}"
    position = next((c.position for c in robot.drive.channels if c.goal == field), "")
    measured = episode.outputs.get(SENSOR, {}).get(position)
    if measured is None:
        raise UsageError(
            f"{path} has no {field!r} of {ACTUATOR!r}",
            hint="is it a log of this robot? Measured positions are a motion only for position-controlled joints",
        )
    return episode.steps[SENSOR].begun_s, measured, f"{position} of {path.name}"


def _within(rows: np.ndarray, config: RecordConfig, robot: Robot, names: Sequence[str]) -> np.ndarray:
    """Return the motion without parts outside the limits at its begin and end, where an arm lies without torque.

    Raises:
        UsageError: The motion leaves the limits in between, or is too fast; the robot has not moved.
    """
    gate, unit, rate_hz = robot.drive.gate(config.gate), robot.units[robot.drive.command], robot.drive.rate_hz
    low, high = (np.broadcast_to(np.asarray(end, np.float64), rows.shape[1]) for end in gate.range)
    beyond = np.maximum(low - rows, rows - high) - _ROUNDED

    def farthest(begin: int, end: int) -> str:
        row, i = map(int, np.unravel_index(beyond[begin:end].argmax(), beyond[begin:end].shape))
        return (
            f"{names[i]} is {rows[begin + row, i]:.3g} {unit} at {row / rate_hz:.2f} s, and must lie in "
            f"[{low[i]:.3g}, {high[i]:.3g}]"
        )

    inside = np.flatnonzero((beyond <= 0.0).all(axis=1))
    if not inside.size:
        raise UsageError(f"{config.motion} is outside of the limits everywhere: {farthest(0, len(rows))}")
    begin, end = int(inside[0]), int(inside[-1]) + 1
    if (beyond[begin:end] > 0.0).any():
        raise UsageError(
            f"{config.motion} leaves the robot's limits: {farthest(begin, end)}",
            hint="record it again within the limits; each is the smaller of the robot's limit and --gate.limit",
        )
    speed = np.abs(np.diff(rows[begin:end], axis=0)) * rate_hz
    most = np.inf if gate.slew_per_s is None else gate.slew_per_s
    if unit == "rad" and gate.max_speed_rad_s is not None:
        most = np.minimum(most, gate.max_speed_rad_s)
    most = np.broadcast_to(most, rows.shape[1])
    if (speed > most).any():
        row, i = map(int, np.unravel_index((speed - most).argmax(), speed.shape))
        raise UsageError(
            f"{config.motion} is too fast: {names[i]} moves at {speed[row, i]:.3g} {unit}/s "
            f"at {row / rate_hz:.2f} s, {most[i]:g} are allowed",
            hint="move slower; --gate.slew-per-s and --gate.max-speed-rad-s are the limits",
        )
    return rows[begin:end]


# -- generated signals


def excitation(config: RecordConfig, rate_hz: float, commands: int = 1) -> np.ndarray:
    """Return the commands of all steps, shape ``(N,)`` for one command, else ``(N, commands)`` [the command's unit].

    ``multisine`` is a sum of twelve sines with random phases between ``low_hz`` and ``high_hz``; ``chirp`` sweeps
    between these in 10 s, and back; ``steps`` has random levels, each held for half a period of a random frequency
    between them. All grow from zero during the first 0.5 s and stay within the amplitude. Several commands are
    independent.

    Args:
        config: Kind of excitation, duration, amplitude, frequencies and seed.
        rate_hz: Commands per second [Hz].
    """
    if config.high_hz > rate_hz / 2:
        raise UsageError(
            f"high_hz = {config.high_hz} Hz is above half the command rate of {rate_hz:g} Hz",
            hint=f"choose at most {rate_hz / 2:g} Hz",
        )
    rng = np.random.default_rng(config.seed)
    t = np.arange(round(config.duration_s * rate_hz)) / rate_hz
    make = {"multisine": _multisine, "chirp": _chirp, "steps": _steps}[config.excitation]
    signals = np.stack([make(t, config.low_hz, config.high_hz, rng) for _ in range(commands)], axis=1)
    played = config.amplitude * np.clip(signals, -1.0, 1.0) * np.minimum(1.0, t / 0.5)[:, None]
    return played[:, 0] if commands == 1 else played


def bent_legs(crouch: np.ndarray, duration_s: float, rate_hz: float) -> np.ndarray:
    """Return commands ``(N, commands)`` with which a standing robot slowly bends and stretches its legs."""
    t = np.arange(0.0, duration_s, 1.0 / rate_hz)
    return 0.5 * (1.0 - np.cos(2.0 * np.pi * _BEND_HZ * t))[:, None] * crouch


def _multisine(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    lines_hz = np.geomspace(low_hz, high_hz, 12)
    phases = rng.uniform(0, 2 * np.pi, lines_hz.size)
    signal = np.sin(2 * np.pi * np.outer(t, lines_hz) + phases).sum(axis=1)
    # Peaks beyond 2.1 standard deviations are clipped at 1: twice the power of a scaling to 3 standard deviations.
    return signal / (3 * signal.std() / np.sqrt(2))


def _chirp(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    sweep = 1.0 - np.abs((t / 10.0) % 2.0 - 1.0)  # 0 to 1 and back in 20 s
    frequency_hz = low_hz * (high_hz / low_hz) ** sweep
    step_s = t[1] - t[0]
    return np.sin(2 * np.pi * np.cumsum(frequency_hz) * step_s + rng.uniform(0, 2 * np.pi))


def _steps(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    signal = np.empty_like(t)
    step_s, begin = t[1] - t[0], 0
    while begin < t.size:
        hold_s = 0.5 / np.exp(rng.uniform(np.log(low_hz), np.log(high_hz)))
        end = begin + max(1, round(hold_s / step_s))
        signal[begin:end] = rng.uniform(-1.0, 1.0)
        begin = end
    return signal
