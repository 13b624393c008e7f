"""Time series of an episode: measurements, commands, and true states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import TICKS_PER_S, Episode
from sim2real.log.schema import unit_of


@dataclass(frozen=True)
class Series:
    """One quantity over time.

    Attributes:
        name: Name of the field, with an index if the field has several entries.
        source: Node or model of the series.
        t_s: Times ``(N,)`` [s].
        values: Values ``(N,)``.
    """

    name: str
    source: str
    t_s: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Signals:
    """The time series of a recorded session.

    Attributes:
        measured: Outputs of nodes without inputs, at the time of the sample.
        commanded: Outputs of the other nodes, at the time of sending.
        truth: True states of an embedded robot, by name.
        units: Field -> unit.
        warnings: Missing parts of the log.
    """

    episode: Episode
    measured: list[Series]
    commanded: list[Series]
    truth: dict[str, Series]
    units: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()

    @property
    def dry(self) -> bool:
        """Whether the commands were not sent."""
        return is_dry(self.episode)

    def last_command(self) -> list[Series]:
        """Return the outputs of the nodes that no other node reads, which are the commands to the motors."""
        graph = self.episode.metadata.get("graph", {})
        read = {i.get("from") for node in graph.values() for i in node.get("inputs", {}).values()}
        last = [s for s in self.commanded if s.source not in read]
        return last or self.commanded


@dataclass(frozen=True)
class ComparedSeries:
    """One quantity on the robot and in simulation.

    Attributes:
        label: Name of the quantity; for a command, with its node.
        simulation: The series in simulation; None without a simulation.
        held: Whether each value holds until the next one, like a command.
        angle: Whether it is an angle: then differences are taken modulo a turn.
    """

    label: str
    robot: Series
    simulation: Series | None
    held: bool = False
    angle: bool = False

    @property
    def difference(self) -> np.ndarray | None:
        """Robot minus simulation at the times of the robot ``(N,)``, NaN outside of the simulation's times."""
        if self.simulation is None or not len(self.simulation.t_s):
            return None
        at, t_s, values = self.robot.t_s, self.simulation.t_s, self.simulation.values
        beside = np.interp(at, t_s, values)
        if self.held:
            beside = values[np.maximum(np.searchsorted(t_s, at, side="right") - 1, 0)]
        off = self.robot.values - np.where((at >= t_s[0]) & (at <= t_s[-1]), beside, np.nan)
        return (off + np.pi) % (2 * np.pi) - np.pi if self.angle else off


def is_dry(episode: Episode) -> bool:
    """Return whether a log is of a dry run."""
    return episode.metadata.get("dry_run") is True


def signals_of(recording: Recording) -> Signals:
    """Return the time series of a recorded session.

    Raises:
        Sim2RealError: When the log holds no step.
    """
    episode = recording.episode
    if not episode.duration_s:
        raise Sim2RealError(f"the log {recording.path} holds no step", hint="record for longer")
    log = outputs_of(episode)
    t_s, states = recording.true_states() or (np.zeros(0), {})
    truth = {n: Series(n, "truth", t_s, values) for n, values in states.items()}
    return replace(log, truth=truth, units=recording.units, warnings=recording.warnings)


def outputs_of(episode: Episode) -> Signals:
    """Return the time series of all nodes of an episode, without true states."""
    graph = episode.metadata.get("graph", {})
    measured, commanded = [], []
    # Nodes with inputs send commands, nodes without inputs measure.
    for node, steps in episode.steps.items():
        inputs = graph.get(node, {}).get("inputs", {}) or [k for k in episode.messages if k[0] == node]
        outputs = episode.outputs.get(node, {})
        if inputs:
            commanded += _node_series(node, steps.end / TICKS_PER_S, outputs)
        else:
            measured += _node_series(node, steps.begun_s, outputs)
    units = {field: unit for by_field in episode.units.values() for field, unit in by_field.items()}
    return Signals(episode, measured, commanded, {}, units)


def simulated_series(columns: Mapping[str, np.ndarray]) -> list[Series]:
    """Return the series of one simulated episode: fields ``NAME`` at times ``t_NAME``, else ``t``."""
    series: list[Series] = []
    for name, values in columns.items():
        if name == "t" or name.startswith("t_"):
            continue
        t_s = columns.get(f"t_{name.partition('[')[0]}", columns["t"])  # the entries of a vector have common times
        if len(t_s) != len(values):
            # Commands without times are spread evenly: their rate differs from the measurements'.
            t_s = np.arange(len(values)) * (float(columns["t"][-1]) / len(values))
        series += components(name, "simulation", t_s, values)
    return series


def simulated_beside(columns: Mapping[str, np.ndarray], log: Signals) -> list[Series]:
    """Return the series of a simulated episode, with angles shifted by whole turns to the robot's first angle.

    Args:
        columns: See ``simulated_series``.
    """
    real, last = {s.name: s for s in log.measured}, log.last_command()
    real |= {f"command[{i}]": s for i, s in enumerate(last)}
    real |= {"command": last[0]} if len(last) == 1 else {}
    shifted = []
    for series in simulated_series(columns):
        robot = real.get(series.name)
        turns = 0.0
        if robot is not None and unit_of(robot.name, log.units) == "rad" and len(robot.values) and len(series.values):
            turns = np.round((robot.values[0] - series.values[0]) / (2 * np.pi))
        shifted.append(replace(series, values=series.values + 2 * np.pi * turns) if np.isfinite(turns) else series)
    return shifted


def pairs_of(log: Signals, simulation: Sequence[Series], joints: Mapping[str, str]) -> list[ComparedSeries]:
    """Return each measurement and each command to the motors with its simulation.

    Args:
        simulation: Result of ``simulated_beside``; empty without a simulation.
        joints: Column of a position -> name of its joint, for labels; other columns are labelled by their names.
    """
    by_name = {s.name: s for s in simulation}
    commands = [s for s in simulation if s.name.partition("[")[0] == "command"]
    pairs = [
        ComparedSeries(joints.get(s.name, s.name), s, by_name.get(s.name), angle=unit_of(s.name, log.units) == "rad")
        for s in log.measured
    ]
    for index, series in enumerate(log.last_command()):
        other = commands[index] if index < len(commands) else None
        pairs.append(ComparedSeries(f"{series.source}.{series.name}", series, other, held=True))
    return pairs


def components(name: str, source: str, t_s: np.ndarray, values: np.ndarray) -> list[Series]:
    """Return one series for each entry of a field; empty for a field without numbers.

    Args:
        source: Node or model of the field.
        t_s: Times ``(N,)`` [s].
        values: Values ``(N, ...)``.
    """
    values = np.asarray(values)
    if values.dtype.kind not in "fiub" or not values.size:
        return []
    flat = values.reshape(len(values), -1).astype(np.float64)
    if flat.shape[1] == 1:
        return [Series(name, source, t_s, flat[:, 0])]
    return [Series(f"{name}[{i}]", source, t_s, flat[:, i]) for i in range(flat.shape[1])]


def _node_series(node: str, times_s: np.ndarray, outputs: Mapping[str, np.ndarray]) -> list[Series]:
    return [s for name, values in outputs.items() for s in components(name, node, times_s, values)]
