"""Predict which parameters a recording, or a planned one, can determine, before a search.

The coverage of a recording needs no JAX: its sampling times, the motion of its joints, and the ranges of its commands.
Which parameters it determines follows from the residuals, linearised at the nominal values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim2real import pytree
from sim2real.artifacts.files import plain, to_json
from sim2real.artifacts.paths import shown
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import NotInstalled, Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identification.model import IdentifiableModel, measured_channels, position_of
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.segments import Span, check_log
from sim2real.installation import has_jax
from sim2real.log.importing.checks import slow_sides
from sim2real.log.importing.names import about_torque
from sim2real.log.schema import unit_of
from sim2real.robots.robot import RecordedRobot, Robot, in_world
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.load import AnyRobot, defaults_of, robot_of
from sim2real.stages.session.excitation import played
from sim2real.stages.shared.arguments import AnyRecording, config_of, open_recording, recordings_of
from sim2real.stages.shared.find_run import newest_recording
from sim2real.stages.shared.identification import command, side_by_side, usable
from sim2real.stages.terminal.console import artifact_table, note, pairs, progress
from sim2real.types import Json

PLANNED = "planned excitation"
_GOAL = 0.01
"""Desired standard error, as a share of the nominal value."""
_MIN_SEGMENT_S = 0.3
_MAX_SEGMENTS = 120
"""Most segments that are simulated, evenly distributed over the log: more do not change the result."""
_GAP = 2.5
"""Pauses longer than this many periods are gaps."""
_STILL = 0.05
"""A joint rests below this share of its highest speed, or below three standard deviations of a measured speed."""
_NOISE_ORDER = 6
"""Differences of this order keep 0.2 % of a motion at a tenth of the sampling rate, and all white noise."""
_WINDOW_S = 0.03
_SHORT_S, _LEAST_MOVING, _ONE_SIDED = 12.0, 0.3, 0.2


@dataclass(frozen=True)
class SignalCoverage:
    """What a recording covers of a joint's position, or of a command.

    Attributes:
        fastest: The highest speed of a joint.
        moving: Share of the time in which a joint moves.
        forward: Share of that time in which its position increases.
    """

    name: str
    unit: str
    low: float
    high: float
    fastest: float | None = None
    moving: float = 0.0
    forward: float = 0.0


@dataclass(frozen=True)
class Coverage:
    """What a recording covers.

    Attributes:
        duration_s: From the first to the last sample [s].
        rate_hz: Median rate [Hz].
        gaps: Number of pauses longer than two and a half periods.
        longest_gap_s: 0 without gaps [s].
        doubts: Sentences on a recorded torque that may be no command.
        too_seldom: Sentences on commands or measurements that are logged too seldom for the motion.
    """

    name: str
    samples: int
    duration_s: float
    rate_hz: float
    gaps: int
    longest_gap_s: float
    joints: tuple[SignalCoverage, ...] = ()
    commands: tuple[SignalCoverage, ...] = ()
    doubts: tuple[str, ...] = ()
    too_seldom: tuple[str, ...] = ()

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each reason why this recording determines little."""
        if self.gaps:
            yield f"{self.gaps} gaps in the measurements, the longest {self.longest_gap_s:.3g} s"
        for joint in self.joints:
            if not joint.moving:
                yield f"{joint.name} does not move at all: nothing about it is determined"
                continue
            if joint.moving < _LEAST_MOVING:
                yield f"{joint.name} moves {joint.moving:.0%} of the time: excite it more, or for longer"
            if not _ONE_SIDED < joint.forward < 1 - _ONE_SIDED:
                yield f"{joint.name} moves almost only one way: friction and an offset then look alike"
        yield from (*self.too_seldom, *self.doubts)
        if self.commands and all(c.high == c.low for c in self.commands):
            yield "no command changes: gains and delays of the actuator are not determined"

    def show(self) -> None:
        """Print the sampling, the motion of the joints and the ranges of the commands."""
        gaps = f"{self.gaps}, the longest {self.longest_gap_s:.3g} s" if self.gaps else "none"
        sampled = f"{self.samples} samples in {self.duration_s:.1f} s, {self.rate_hz:.4g} Hz, gaps: {gaps}"
        rows = []
        for s in (*self.joints, *self.commands):
            of_joint = ["", "", ""]
            if s.fastest is not None:
                of_joint = [f"{s.fastest:.3g}", f"{s.moving:.0%}", f"{s.forward:.0%}"]
            rows.append([s.name, f"{s.low:.3g} to {s.high:.3g} {s.unit}".rstrip(), *of_joint])
        table = ArtifactTable(("signal", "range", "highest speed", "in motion", "of it upwards"), rows)
        print(f"{pairs({self.name: sampled})}\n\n{artifact_table(table)}\n")


@dataclass(frozen=True)
class ParameterCheck:
    """How well recordings determine one parameter.

    Attributes:
        standard_error_per_minute: Standard error to expect from one minute of such data.
        excite: The motion that determines it, as text.
    """

    name: str
    unit: str
    nominal: float | None
    standard_error_per_minute: float
    excite: str = ""

    @property
    def percent_of_nominal(self) -> float | None:
        """The standard error as a share of the nominal value [%]; None without one."""
        return 100 * self.standard_error_per_minute / abs(self.nominal) if self.nominal else None


@dataclass(frozen=True, repr=False)
class Checked(Shown):
    """Which parameters recordings, or a planned one, determine.

    Attributes:
        undetermined: Groups of parameters; only combinations of the parameters in a group are determined.
        messages: A sentence for each group.
        following: The command to run next.
    """

    pipeline: str
    recordings: tuple[Coverage, ...]
    undetermined: tuple[tuple[str, ...], ...]
    messages: tuple[str, ...]
    parameters: tuple[ParameterCheck, ...]
    following: str = ""

    @property
    def determined(self) -> bool:
        """Whether every parameter is determined; of the delays the sum suffices."""
        return not (self.undetermined or self.too_seldom)

    @property
    def too_seldom(self) -> bool:
        """Whether commands or measurements are logged too seldom, so that the motion between them is unknown."""
        return any(r.too_seldom for r in self.recordings)

    @property
    def in_groups(self) -> tuple[str, ...]:
        """The parameters that the data determines only in combination."""
        return tuple(dict.fromkeys(name for group in self.undetermined for name in group))

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        if self.too_seldom:
            return "record again: commands or measurements are logged too seldom for this motion"
        if self.undetermined:
            names = ", ".join(self.in_groups)
            return f"do not identify yet: some of {names} would be guesses; --fix NAME VALUE holds a known one"
        one = "this plan determines" if self.recordings[0].name == PLANNED else "this log determines"
        return f"{one if len(self.recordings) == 1 else 'these logs determine'} every parameter"

    @property
    def recommendation(self) -> tuple[str, ...]:
        """Sentences: the problems of the data, the motion to record instead, and how long to record."""
        have_s, several = sum(r.duration_s for r in self.recordings), len(self.recordings) > 1
        texts = [f"only {have_s:.1f} s: too little to fit one part and check on another"] if have_s < _SHORT_S else []
        texts += [f"{r.name}: {text}" if several else text for r in self.recordings for text in r.problems()]
        if motions := dict.fromkeys(p.excite for p in self.parameters if p.excite and p.name in self.in_groups):
            texts.append(f"record instead: {'; '.join(motions)}")
        # How long to record follows from the parameter with the largest standard error.
        alone = [(p.percent_of_nominal, p.name) for p in self.parameters if p.name not in self.in_groups]
        if known := [(percent, name) for percent, name in alone if percent]:
            percent, worst = max(known)
            seconds = 60.0 * (percent / (100 * _GOAL)) ** 2
            enough = f"{have_s:.0f} s are enough for {_GOAL:.0%}, if the model is right"
            more = f"{_GOAL:.0%} takes {_time(seconds)} of such data, or a better excitation"
            about = f"{worst} is least certain: {percent:.2g} % of nominal from a minute"
            texts.append(f"{about}; {enough if seconds <= have_s else more}")
        return tuple(texts)

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        why = "; ".join([*self.messages, *self.recommendation])
        return {"pipeline": self.pipeline, "verdict": self.verdict, "why": why, "next": self.following}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        headers = ("parameter", "nominal", "s.e. from a minute", "unit", "of nominal", "determined")
        rows = [
            [
                *(p.name, p.nominal, p.standard_error_per_minute, p.unit),
                None if p.percent_of_nominal is None else f"{p.percent_of_nominal:.2g} %",
                "in a group" if p.name in self.in_groups else "alone",
            ]
            for p in self.parameters
        ]
        return ArtifactTable(headers, rows)


def run(robot: RecordedRobot, config: CheckConfig) -> bool:
    """Judge recordings and print the result: the verdict and the next command first.

    Returns:
        Whether every parameter is determined; of the delays the sum suffices.
    """
    checked = check(robot, None, config)
    if config.json:
        more = {"determined": checked.determined, "verdict": checked.verdict, "recommendation": checked.recommendation}
        print(to_json({**plain(checked), **more}).decode())
        return checked.determined
    print(f"verdict: {checked.verdict}")
    print(f"next: {checked.following}")
    for message in [*checked.messages, *checked.recommendation]:
        print(f"- {message}")
    print()
    for recording in checked.recordings:
        recording.show()
    print(artifact_table(checked.rows()))
    return checked.determined


def check(
    robot: AnyRobot,
    recording: AnyRecording | Sequence[AnyRecording] | None = None,
    config: CheckConfig | Mapping[str, Json] | None = None,
) -> Checked:
    """Predict which parameters recordings can determine, before a search.

    Args:
        robot: The robot, or the name of its pipeline.
        recording: One recording, or several; or the paths of their logs. None: the logs that ``config`` names, the
            newest recording in its ``runs``, or, without one, the planned excitation.
        config: A dict holds the fields that differ from the default.

    Raises:
        NotInstalled: JAX is not installed; the coverage of the recordings is printed before.
    """
    # Make the model that `identify` would fit.
    robot = robot_of(robot)
    config = config_of(config, CheckConfig(record=defaults_of(robot).record))
    robot = in_world(robot, config.world)
    # The squared loss, because a robust loss would hide the errors of the nominal model.
    fitting = replace(defaults_of(robot).identify, bounds=config.bounds, fix=config.fix, reach=np.inf)
    model = robot.identifiable(fitting.max_delay_s)
    parameters = model.parameters.with_bounds(config.bounds).with_fixed(config.fix)
    # Open the recordings, or simulate the planned one.
    if recording is None:
        logs = find_logs(robot, config)
        planned = not logs
        logs = logs or {PLANNED: _planned(robot, config, model, parameters, fitting)}
    else:
        recordings = recordings_of(recording, robot)
        config, planned = replace(config, log=tuple(str(log.path) for log in recordings), plan=False), False
        logs = {shown(log.path): log.episode for log in recordings}
    model = measured_channels(model, list(logs.values()))
    # Refuse logs that determine no parameter, even without JAX.
    for episode in logs.values():
        check_log(episode, model)
    covered = tuple(coverage(name, episode, model, robot.units) for name, episode in logs.items())
    if not has_jax():
        if config.json:
            print(to_json({"recordings": covered}).decode())
        else:
            for recording_ in covered:
                recording_.show()
        raise NotInstalled(
            "which parameters this recording determines is computed with JAX, which is not installed here",
            hint=f"copy it to a computer with sim2real: `sim2real check {robot.name} --log LOG`",
        )
    with progress(None, "check: simulate"):
        checked = determine(model, list(logs.values()), fitting, parameters)
    # Name the next command: where a parameter is not determined, it plans or records another motion.
    flags = {"log": config.log, "bounds": config.bounds, "fix": config.fix, "world": config.world}
    following = command(robot, replace(defaults_of(robot).identify, **flags), config.runs)
    checked = replace(checked, pipeline=robot.name, recordings=covered)
    if checked.too_seldom:
        following = "log the slower side as often as the first sentence below says, or move more slowly"
    elif isinstance(robot, Robot) and not checked.determined:
        following = f"sim2real check {robot.name} --plan --record.excitation KIND, then record what suffices"
    elif not checked.determined:
        following = f"record such a motion, or hold a known value: {following} --fix {checked.undetermined[0][0]} VALUE"
    elif planned:
        following = f"sim2real record {robot.name}"
    return replace(checked, following=following)


def find_logs(robot: RecordedRobot, config: CheckConfig) -> dict[str, Episode]:
    """Return the logs that the configuration names, or the newest recording; empty if an excitation is planned."""
    paths = [Path(p) for p in config.log]
    if not paths and not config.plan:
        try:
            paths = newest_recording(robot, config.runs).logs()
        except Sim2RealError:
            if not isinstance(robot, Robot):
                raise
            note(f"no recording of {robot.name} in {shown(config.runs)}: the planned excitation is simulated")
    return {shown(p): open_recording(p, robot).episode for p in paths}


def _planned(
    robot: RecordedRobot,
    config: CheckConfig,
    model: IdentifiableModel,
    parameters: ParameterTable,
    fitting: IdentifyConfig,
) -> Episode:
    """Return a simulation of the planned excitation, at the nominal values."""
    if not isinstance(robot, Robot):
        raise UsageError(
            f"pipeline {robot.name!r} has no excitation to plan a recording with", hint="name a log with --log FILE"
        )
    if config.record.by_hand:
        raise UsageError(
            "a recording by hand determines no parameter: torque is off, and the hand's torque is not measured",
            hint="record it, play it with `sim2real record PIPELINE --excitation LOG`, and check that",
        )
    if config.record.standing:
        raise UsageError("a recording of standing determines only the load", hint="plan another --record.excitation")
    if not has_jax():
        raise NotInstalled("a plan is simulated with JAX, which is not installed here", hint="name a log with --log")
    from sim2real.stages.session.simulated_log import simulate  # JAX programs

    signal = played(config.record, robot) + robot.drive.centre
    values = parameters.decode(parameters.start())
    return simulate(model, robot, signal, values, fitting, config.record.seed)


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else "hours"


def coverage(name: str, episode: Episode, model: IdentifiableModel, units: Mapping[str, str]) -> Coverage:
    """Return what a recording covers.

    Args:
        model: Names the nodes and fields that are compared.
        units: Field -> unit.
    """
    begun_s, fields = np.asarray(episode.steps[model.sensor].begun_s), dict(units)
    joints = []
    for channel in model.channels:
        outputs = episode.outputs[model.sensor]
        position = np.asarray(channel.of(outputs[channel.position]), np.float64)
        # A robot that does not measure velocities gets them from differences of positions.
        velocity = speed(begun_s, position) if channel.velocity is None else channel.of(outputs[channel.velocity])
        ends = (float(position.min()), float(position.max()), float(np.abs(velocity).max()))
        unit = unit_of(position_of(channel), fields)
        joints.append(SignalCoverage(channel.name, unit, *ends, *motion_of(begun_s, position)))
    duration_s = float(begun_s[-1] - begun_s[0]) if len(begun_s) else 0.0
    gaps, longest_s, rate_hz = sampling(begun_s)
    return Coverage(
        *(name, len(begun_s), duration_s, rate_hz, gaps, longest_s, tuple(joints)),
        commands=tuple(_commands(episode, model, fields)),
        doubts=tuple(about_torque(episode.metadata.get("mapping") or {})),
        too_seldom=tuple(slow_sides(episode)),
    )


def _commands(episode: Episode, model: IdentifiableModel, units: dict[str, str]) -> Iterator[SignalCoverage]:
    """Yield each command, named by its joint if the field has a value for each joint."""
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
                unit = unit_of(f"{field}[{i}]", units)
                yield SignalCoverage(name, unit, float(column.min()), float(column.max()))


def sampling(t_s: np.ndarray) -> tuple[int, float, float]:
    """Return the number of gaps, the longest gap [s] and the median rate [Hz] of times ``(N,)`` [s]."""
    steps = np.diff(np.asarray(t_s, np.float64))
    if not steps.size:
        return 0, 0.0, 0.0
    period = float(np.median(steps))
    gaps = steps[steps > _GAP * period]
    return int(gaps.size), float(gaps.max(initial=0.0)), 1.0 / period if period > 0 else 0.0


def speed(t_s: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the speed of a sampled position ``(N,)``, by differences; 0 with fewer than three samples."""
    if len(position) < 3:
        return np.zeros(len(position))
    times = np.asarray(t_s, np.float64)
    steps = np.maximum(np.diff(times), 1e-9)  # equal stamps must not make the speed infinite
    return np.gradient(np.asarray(position, np.float64), times[0] + np.concatenate([[0.0], np.cumsum(steps)]))


def motion_of(t_s: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Return the share of the time in motion, and the share of it upwards, of a joint.

    Positions are averaged over 30 ms, so that the noise of fast samples does not hide slow motion; noise, glitches and
    quantisation do not count as motion.

    Args:
        t_s: Times ``(N,)`` [s].
        position: Positions ``(N,)``.
    """
    t_s, position = np.asarray(t_s, np.float64), np.asarray(position, np.float64)
    good = np.isfinite(position) & np.isfinite(t_s)
    t_s, position, noise = t_s[good], position[good], 0.0
    if len(position) >= 3 * _NOISE_ORDER:
        # The standard deviation of white noise, by high-order differences without the largest 2 %, which are leaps.
        squares = np.sort(np.diff(position, _NOISE_ORDER) ** 2)[: math.ceil(0.98 * (len(position) - _NOISE_ORDER))]
        noise = float(np.sqrt(squares.mean() / math.comb(2 * _NOISE_ORDER, _NOISE_ORDER)))
        width = min(max(1, round(_WINDOW_S / max(float(np.median(np.diff(t_s))), 1e-9))), len(position) // 3)
        # Compare the range of the averages with the noise and the steps of the readings.
        least = max(1.5 * float(np.diff(np.unique(position)).min(initial=np.inf)), 8.0 * noise / np.sqrt(width))
        mean = np.full(width, 1.0 / width)
        noise /= width * max(float(np.median(np.diff(t_s))), 1e-9)
        t_s, position = (np.convolve(values, mean, "valid") for values in (t_s - t_s[0], position))
        if not np.ptp(np.quantile(position, [0.005, 0.995])) > least:
            return 0.0, 0.0
    velocity = speed(t_s, position)
    # Compare with the 99 % quantile: a rare spike must not make the other speeds count as standing still.
    still = max(_STILL * float(np.quantile(np.abs(velocity), 0.99)), 3.0 * noise) if velocity.size else 0.0
    fast = np.abs(velocity) > still
    if not fast.any():
        return 0.0, 0.0
    return float(fast.mean()), float((velocity[fast] > 0).mean())


def determine(
    model: IdentifiableModel, episodes: Sequence[Episode], config: IdentifyConfig, parameters: ParameterTable
) -> Checked:
    """Return which parameters recordings determine: their residuals are simulated once, at the nominal values."""
    from sim2real.identification.residuals import Problem  # imports JAX
    from sim2real.identification.uncertainty import determined as what_is_determined

    spans, length_s = cut_segments(episodes, config)
    problem = Problem(model, episodes, spans, length_s, config, parameters)
    found = what_is_determined(problem, problem.linearise(problem.table.start()))
    errors = found.standard_error_per_minute
    rows = [ParameterCheck(c.name, c.unit, c.nominal, errors[c.name], c.excite) for c in problem.table.columns]
    return Checked("", (), found.undetermined, found.messages, tuple(rows))


def cut_segments(episodes: Sequence[Episode], config: IdentifyConfig) -> tuple[list[Span], float]:
    """Return segments side by side, all of them fitted, and their length [s]."""
    ends = [usable(e, config) for e in episodes]
    shortest_s = min(end - begin for begin, end in ends)
    length_s = min(config.settle_s + config.horizon_s, shortest_s)
    if length_s < _MIN_SEGMENT_S:
        raise UsageError(
            f"the shortest recording lasts {min(e.duration_s for e in episodes):.2f} s: too short for a segment",
            hint="record for at least 12 s",
        )
    spans = side_by_side(episodes, config, [length_s] * len(episodes))
    if len(spans) > _MAX_SEGMENTS:
        spans = [spans[i] for i in np.linspace(0, len(spans) - 1, _MAX_SEGMENTS).round().astype(int)]
    return spans, length_s
