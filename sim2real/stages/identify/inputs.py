"""Recordings, model and parameters of an identification, checked before anything is simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import Source, portable
from sim2real.errors import OtherMotion
from sim2real.graph.episode import Episode
from sim2real.identification.delays import measured
from sim2real.identification.model import HasLimits, IdentifiableModel, measured_channels
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.segments import Span
from sim2real.robots.robot import RecordedRobot, Robot, in_world
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.shared.arguments import require_units
from sim2real.stages.shared.identification import (
    hash_of,
    offering,
    require_apart,
    spans,
    with_length,
    with_wanted_terms,
)
from sim2real.stages.terminal.console import note

Bounds = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Inputs:
    """The data of an identification.

    Attributes:
        loaded: The robot as its pipeline makes it, in its own world and with its own terms.
        robot: The robot in the configured world, with the optional terms that the configuration names.
        table: The parameters, with the bounds and fixed values of the configuration.
        logs: The fitted recordings, then the recordings that are held out as a whole.
        hashes: SHA-256 of each log's file before the fit; "" for a recording without a file.
        windows: Segments of one length: those to fit, and the held-out ones, which are predicted.
        standing: The recording of a robot on its feet; None: there is none.
    """

    loaded: RecordedRobot
    config: IdentifyConfig
    robot: RecordedRobot
    model: IdentifiableModel
    table: ParameterTable
    logs: tuple[Recording, ...]
    hashes: tuple[str, ...]
    fitted: int
    windows: list[Span]
    standing: Recording | None = None

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters of training that no log of the robot determines."""
        known = self.robot.nominal() if isinstance(self.robot, Robot) else ()
        return tuple(name for name in known if name not in self.model.parameters.names)

    def sources(self, run_dir: Path | None = None) -> tuple[Source, ...]:
        """Return the logs with their hashes from before the fit.

        Args:
            run_dir: Folder to which paths are relative; None: only names.
        """
        paths = [log.path.name if run_dir is None else portable(log.path, run_dir) for log in self.logs]
        return tuple(Source(*pair) for pair in zip(paths, self.hashes, strict=True))

    @property
    def episodes(self) -> list[Episode]:
        """The episode of each recording."""
        return [log.episode for log in self.logs]

    @property
    def names(self) -> list[str]:
        """A name for each fitted recording."""
        return [f"log {i + 1}: {log.path.stem}" for i, log in enumerate(self.logs[: self.fitted])]

    @property
    def units(self) -> dict[str, str]:
        """Field -> unit."""
        return {**self.robot.units, **self.logs[0].units}


def prepare(
    robot: RecordedRobot,
    config: IdentifyConfig,
    fitted: Sequence[Recording],
    held_out: Sequence[Recording],
    begin: Mapping[str, float] | None = None,
    standing: Recording | None = None,
) -> Inputs:
    """Return the data of an identification.

    Args:
        begin: Values at which the search begins; default: the model's.
        standing: The recording of a robot on its feet.

    Raises:
        UsageError: The recordings are too short, one is given twice, or the configuration does not fit the model.
        Sim2RealError: A recording has other units than the robot.
    """
    loaded, robot = robot, configured(robot, config)
    logs = (*fitted, *held_out)
    for log in (*logs, *([standing] if standing else [])):
        require_units(log, robot)
    model = measured_channels(robot.identifiable(config.max_delay_s), [log.episode for log in logs])
    require_apart(fitted, held_out, model)
    episodes = [log.episode for log in fitted]
    table = table_of(model, config, episodes).with_begin(begin or {})
    config = with_length(config, model)
    if standing:
        from sim2real.robots.walking import weighing

        weighing.check(robot, standing.episode, {p.name: p.nominal for p in model.parameters})
    windows = spans([log.episode for log in logs], len(fitted), config, config.settle_s + config.horizon_s)
    hashes = tuple(hash_of(log) for log in logs)
    return Inputs(loaded, config, robot, model, table, logs, hashes, len(fitted), windows, standing=standing)


def with_load(
    document: Identification, robot: RecordedRobot, log: Recording, truth: Mapping[str, float]
) -> Identification:
    """Return an identification with the load, from a log of the robot on its feet; see ``weighing.weighed``.

    A load outside of its bounds is a warning: the rest is identified.
    """
    from sim2real.robots.walking import weighing  # imported late: only walking robots need it

    try:
        return weighing.weighed(robot, document, log.episode, truth)
    except OtherMotion as error:
        note(f"warning: the load is not identified: {error}")
        return document


def configured(robot: RecordedRobot, config: IdentifyConfig) -> RecordedRobot:
    """Return a robot in the configured world, with the optional terms that the configuration names."""
    return offering(in_world(robot, config.world), config.terms)


def with_terms(inputs: Inputs, wanted: str, selected: str = "", bounds: Bounds | None = None) -> Inputs:
    """Return the inputs of the robot with optional terms; the settings stay.

    Args:
        wanted: The terms that the robot's model gets.
        selected: The terms that are identified; default: ``wanted``.
        bounds: Further bounds.
    """
    robot = configured(inputs.loaded, replace(inputs.config, terms=wanted))
    model = measured_channels(robot.identifiable(inputs.config.max_delay_s), inputs.episodes)
    config = replace(inputs.config, terms=selected or wanted, bounds={**inputs.config.bounds, **(bounds or {})})
    table = table_of(model, config, inputs.episodes[: inputs.fitted])
    return replace(inputs, robot=robot, model=model, table=table)


def table_of(model: IdentifiableModel, config: IdentifyConfig, episodes: Sequence[Episode]) -> ParameterTable:
    """Return the model's parameters with the configured terms, bounds and fixed values.

    Args:
        episodes: The fitted recordings: the bounds of limits follow from what they reach.
    """
    bounded = model.parameters.with_bounds(config.bounds)
    if isinstance(model, HasLimits) and config.terms not in ("own", "none"):
        bounded = bounded.with_reached(model.reached(episodes))
    table = with_wanted_terms(bounded, config.terms).with_fixed(config.fix)
    # If the data sheet has one of the two delays, it is fixed, and the other delay is identified.
    for p in table:
        held = p.kind == "delay" and p.side == "measurement" and not p.free and p.name not in config.fix
        if held and any(q.name in config.fix for q in table if q.kind == "delay" and q.side == "command"):
            table = table.with_free(p.name)
    if config.links:
        measured(table)  # raises an error before the search if the model has no such delay
    return table
