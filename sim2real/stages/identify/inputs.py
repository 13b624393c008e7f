"""Recordings, model and parameters of an identification, checked before anything is simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim2real.artifacts.recording import Recording
from sim2real.graph.episode import Episode
from sim2real.identify.delays.links import measured
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.segments import Span
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.fitted_logs import require_apart
from sim2real.stages.estimation.segment_split import spans
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.open_log import require_units
from sim2real.stages.pipeline.pipeline import Pipeline


@dataclass(frozen=True)
class Inputs:
    """The data of an identification.

    Attributes:
        robot: The robot, with the optional terms that the configuration names.
        table: The parameters, with the bounds and fixed values of the configuration.
        logs: The fitted recordings, then those that are held out whole.
        windows: Segments to fit, and segments to predict.
    """

    pipeline: Pipeline
    config: IdentifyConfig
    robot: RecordedRobot
    model: IdentifiableModel
    table: ParameterTable
    logs: tuple[Recording, ...]
    fitted: int
    windows: list[Span]

    @property
    def episodes(self) -> list[Episode]:
        """One episode a recording."""
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
    pipeline: Pipeline,
    config: IdentifyConfig,
    fitted: Sequence[Recording],
    held_out: Sequence[Recording],
    begin: Mapping[str, float] | None = None,
) -> Inputs:
    """Return the data of an identification.

    Args:
        begin: Values at which the search begins; default: the pipeline's.

    Raises:
        UsageError: When the recordings are too short, one is given twice, or the configuration does not fit the model.
        Sim2RealError: When a recording is in other units than the robot.
    """
    robot = robot_of(pipeline, config)
    logs = (*fitted, *held_out)
    for log in logs:
        require_units(log, robot)
    model = robot.identifiable(config.max_delay_s)
    require_apart(fitted, held_out, model, config.force)
    table = table_of(model, config).with_begin(begin or {})
    windows = spans([log.episode for log in logs], len(fitted), config, config.settle_s + config.horizon_s)
    return Inputs(pipeline, config, robot, model, table, logs, len(fitted), windows)


def robot_of(pipeline: Pipeline, config: IdentifyConfig) -> RecordedRobot:
    """Return the pipeline's robot in the configured world, with the optional terms that the configuration names."""
    return held_out_parts.offering(in_world(pipeline.load(), config.world), config.terms)


def table_of(model: IdentifiableModel, config: IdentifyConfig) -> ParameterTable:
    """Return the model's parameters with the configured terms, bounds and fixed values."""
    table = held_out_parts.widest(model.parameters.with_bounds(config.bounds), config.terms).with_fixed(config.fix)
    if config.links:
        measured(table)  # raises an error before the search if the model has no such delay
    return table
