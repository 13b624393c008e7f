"""The coverage of a recording: its sampling times, the motion of its joints, and the ranges of its commands. No JAX."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim2real import pytree
from sim2real.artifacts.summary import ArtifactTable
from sim2real.graph.episode import Episode
from sim2real.identify.model import Channel, IdentifiableModel, position_of
from sim2real.log.importing.names import about_torque
from sim2real.log.schema import unit_of

_GAP = 2.5
"""Pauses longer than this many periods are gaps."""
_STILL = 0.05
"""A joint stands still below this share of its highest speed, or below three deviations of a measured speed."""
_NOISE_ORDER = 6
"""Differences of this order keep 0.2 % of a motion at a tenth of the sampling rate, and all white noise."""
_WINDOW_S = 0.03
_SHORT_S = 12.0
_LEAST_MOVING, _ONE_SIDED = 0.3, 0.2


@dataclass(frozen=True)
class Motion:
    """The time in motion of a joint.

    Attributes:
        moving: Share of the time in motion.
        forward: Share of that time in which the position increases.
        reversals: Number of changes of direction.
    """

    moving: float
    forward: float
    reversals: int


@dataclass(frozen=True)
class JointCoverage:
    """The range of a joint's position, its highest speed, and its time in motion."""

    name: str
    unit: str
    low: float
    high: float
    fastest: float
    motion: Motion

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each reason why this motion determines little."""
        m = self.motion
        if not m.moving:
            yield f"{self.name} does not move at all: nothing about it is determined"
            return
        if m.moving < _LEAST_MOVING:
            yield f"{self.name} moves {m.moving:.0%} of the time: excite it more, or for longer"
        if not _ONE_SIDED < m.forward < 1 - _ONE_SIDED:
            yield f"{self.name} moves almost only one way: friction and an offset then look alike"


@dataclass(frozen=True)
class CommandCoverage:
    """The range of a command."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Coverage:
    """What a recording covers.

    Attributes:
        duration_s: From the first to the last sample [s].
        rate_hz: Median rate [Hz].
        gaps: Number of pauses longer than two and a half periods.
        longest_gap_s: 0 without gaps [s].
        about_torque: Doubts that a torque is a command.
    """

    name: str
    samples: int
    duration_s: float
    rate_hz: float
    gaps: int
    longest_gap_s: float
    joints: tuple[JointCoverage, ...] = ()
    commands: tuple[CommandCoverage, ...] = ()
    about_torque: tuple[str, ...] = ()

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each reason why this recording determines little."""
        if self.gaps:
            yield f"{self.gaps} gaps in the measurements, the longest {self.longest_gap_s:.3g} s"
        for joint in self.joints:
            yield from joint.problems()
        yield from self.about_torque
        if self.commands and all(c.high == c.low for c in self.commands):
            yield "no command changes: gains and delays of the actuator are not determined"

    def sampling(self) -> str:
        """Return samples, duration, rate and gaps as text."""
        gaps = f"{self.gaps}, the longest {self.longest_gap_s:.3g} s" if self.gaps else "none"
        return f"{self.samples} samples in {self.duration_s:.1f} s, {self.rate_hz:.4g} Hz, gaps: {gaps}"

    def rows(self) -> ArtifactTable:
        """Return a row for each joint, then one for each command."""
        rows = [
            [
                *(j.name, f"{j.low:.3g} to {j.high:.3g} {j.unit}".rstrip(), f"{j.fastest:.3g}"),
                *(f"{j.motion.moving:.0%}", f"{j.motion.forward:.0%}", j.motion.reversals),
            ]
            for j in self.joints
        ]
        rows += [[c.name, f"{c.low:.3g} to {c.high:.3g} {c.unit}".rstrip(), "", "", "", ""] for c in self.commands]
        return ArtifactTable(("signal", "range", "highest speed", "in motion", "of it upwards", "reversals"), rows)


def coverage(name: str, episode: Episode, model: IdentifiableModel, units: Mapping[str, str]) -> Coverage:
    """Return what a recording covers.

    Args:
        model: Names the nodes and fields that are compared.
        units: Field -> unit.
    """
    begun_s = episode.steps[model.sensor].begun_s
    gaps, longest_s, rate_hz = sampling(begun_s)
    duration_s = float(begun_s[-1] - begun_s[0]) if len(begun_s) else 0.0
    joints = tuple(_joint(c, episode.outputs[model.sensor], units, begun_s) for c in model.channels)
    doubts = tuple(about_torque(episode.metadata.get("mapping") or {}))
    commands = tuple(_commands(episode, model, units))
    return Coverage(name, len(begun_s), duration_s, rate_hz, gaps, longest_s, joints, commands, doubts)


def problems(recordings: Sequence[Coverage]) -> list[str]:
    """Return a sentence for each reason why recordings determine little."""
    have_s = sum(r.duration_s for r in recordings)
    texts = [f"only {have_s:.1f} s: too little to fit one part and check on another"] if have_s < _SHORT_S else []
    several = len(recordings) > 1
    return texts + [f"{r.name}: {text}" if several else text for r in recordings for text in r.problems()]


def _joint(
    channel: Channel, outputs: Mapping[str, np.ndarray], units: Mapping[str, str], begun_s: np.ndarray
) -> JointCoverage:
    position = np.asarray(channel.of(outputs[channel.position]), np.float64)
    # A robot that does not measure velocities gets them from differences of positions.
    velocity = speed(begun_s, position) if channel.velocity is None else channel.of(outputs[channel.velocity])
    low, high, fastest = float(position.min()), float(position.max()), float(np.abs(velocity).max())
    unit = unit_of(position_of(channel), dict(units))
    return JointCoverage(channel.name, unit, low, high, fastest, motion_of(begun_s, position))


def _commands(episode: Episode, model: IdentifiableModel, units: Mapping[str, str]) -> Iterator[CommandCoverage]:
    """Yield each command, named by its joint where the field has a value for each joint."""
    for node, message in model.given.items():
        for field in pytree.leaves(message):
            values = np.asarray(episode.outputs[node][field], np.float64)
            columns = values.reshape(len(values), -1).T
            names = [f"{node}.{field}[{i}]" for i in range(len(columns))]
            if len(columns) == 1:
                names = [f"{node}.{field}"]
            elif len(columns) == len(model.channels):
                names = [f"{field} of {channel.name}" for channel in model.channels]
            for i, (name, column) in enumerate(zip(names, columns, strict=True)):
                low, high = float(column.min()), float(column.max())
                yield CommandCoverage(name, unit_of(f"{field}[{i}]", dict(units)), low, high)


def sampling(t_s: np.ndarray) -> tuple[int, float, float]:
    """Return the number of gaps, the longest gap [s] and the median rate [Hz] of times ``(N,)`` [s]."""
    steps = np.diff(np.asarray(t_s, np.float64))
    if not steps.size:
        return 0, 0.0, 0.0
    period = float(np.median(steps))
    gaps = steps[steps > _GAP * period]
    return int(gaps.size), float(gaps.max(initial=0.0)), 1.0 / period if period > 0 else 0.0


def speed(t_s: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the rate of a sampled position ``(N,)``, by differences; 0 with fewer than three samples."""
    if len(position) < 3:
        return np.zeros(len(position))
    times = np.asarray(t_s, np.float64)
    steps = np.maximum(np.diff(times), 1e-9)  # equal stamps must not make it infinite
    return np.gradient(np.asarray(position, np.float64), times[0] + np.concatenate([[0.0], np.cumsum(steps)]))


def motion(velocity: np.ndarray, sigma: float = 0.0) -> Motion:
    """Return the motion of a joint with velocities ``(N,)`` and their deviation."""
    velocity = np.asarray(velocity, np.float64)
    # Compare with the 99 % quantile: a rare spike must not make the other speeds count as standing still.
    still = max(_STILL * float(np.quantile(np.abs(velocity), 0.99)), 3.0 * sigma)
    fast = np.abs(velocity) > still
    if not fast.any():
        return Motion(0.0, 0.0, 0)
    signs = np.sign(velocity[fast])
    return Motion(float(fast.mean()), float((signs > 0).mean()), int((np.diff(signs) != 0).sum()))


def motion_of(t_s: np.ndarray, position: np.ndarray) -> Motion:
    """Return the motion of a joint with positions ``(N,)`` at times ``(N,)`` [s]; noise and quantisation do not count.

    Speeds are those of positions averaged over 30 ms, so that the noise of fast samples does not hide slow motion.
    """
    t_s, position = np.asarray(t_s, np.float64), np.asarray(position, np.float64)
    good = np.isfinite(position) & np.isfinite(t_s)
    t_s, position = t_s[good], position[good]
    if len(position) < 3 * _NOISE_ORDER:
        return motion(speed(t_s, position))
    period_s = max(float(np.median(np.diff(t_s))), 1e-9)
    # Average over 30 ms.
    width = min(max(1, round(_WINDOW_S / period_s)), len(position) // 3)
    mean = np.full(width, 1.0 / width)
    deviation = _noise(position)
    times, smooth = (np.convolve(values, mean, "valid") for values in (t_s - t_s[0], position))
    # Compare the range of the averages with the noise and the steps of the readings.
    least = max(1.5 * float(np.diff(np.unique(position)).min(initial=np.inf)), 8.0 * deviation / np.sqrt(width))
    if not np.ptp(np.quantile(smooth, [0.005, 0.995])) > least:
        return Motion(0.0, 0.0, 0)
    return motion(speed(times, smooth), deviation / (width * period_s))


def _noise(values: np.ndarray) -> float:
    """Return the deviation of white noise in values ``(N,)``, by high differences without the largest 2 %: leaps."""
    squares = np.sort(np.diff(values, _NOISE_ORDER) ** 2)
    return float(np.sqrt(squares[: math.ceil(0.98 * squares.size)].mean() / math.comb(2 * _NOISE_ORDER, _NOISE_ORDER)))
