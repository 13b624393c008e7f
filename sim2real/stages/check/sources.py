"""The recordings that check judges: given logs, the newest recording, or a simulation of the planned excitation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.run.run_folder import newest
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.contract import Robot
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.excitation.played import played
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import note, shown

PLANNED = "planned excitation"


@dataclass(frozen=True)
class JudgedLogs:
    """The recordings that are judged, or one simulated recording of the planned excitation."""

    names: list[str]
    episodes: list[Episode]
    planned: bool


def find_source(
    pipeline: Pipeline,
    config: CheckConfig,
    model: IdentifiableModel,
    parameters: ParameterTable,
    fitting: IdentifyConfig,
) -> JudgedLogs:
    """Return the logs that ``config`` names; without any the newest recording; without any the planned excitation.

    Args:
        parameters: Their nominal values are simulated.
    """
    # Take the named logs, or the newest recording.
    paths, robot = [Path(p) for p in config.log], pipeline.load()
    if not paths and not config.plan:
        try:
            paths = [newest(config.runs, pipeline.name, "record").output("log")]
        except Sim2RealError as error:
            if not isinstance(robot, Robot):
                raise UsageError(
                    f"there is no recording of {pipeline.name!r} in {shown(config.runs)}, and the pipeline has no "
                    "excitation to plan one with",
                    hint=f"name a log with --log FILE, or `sim2real import FILE --pipeline {pipeline.name}`",
                ) from error
            note(f"no recording of {pipeline.name} in {shown(config.runs)}: the planned excitation is simulated")
    # Open them.
    if paths:
        return JudgedLogs([shown(p) for p in paths], [open_recording(p, pipeline, robot).episode for p in paths], False)
    if not isinstance(robot, Robot):
        raise UsageError(
            f"pipeline {pipeline.name!r} has no excitation to plan a recording with", hint="name a log with --log FILE"
        )
    # Simulate the planned commands with the nominal parameters.
    from sim2real.stages.excitation.simulated_log import simulate  # JAX programs

    moving = moving_robot(pipeline)
    if config.record.by_hand:
        raise UsageError(
            "a recording by hand determines no parameter: torque is off, and the hand's torque is not measured",
            hint="record it, play it with `sim2real record PIPELINE --excitation LOG`, and check that",
        )
    if config.record.standing:
        raise UsageError("a recording of standing determines the load alone", hint="plan another --record.excitation")
    signal = moving.drive.around(played(config.record, pipeline, moving))
    table = parameters.for_recordings(1)
    values = table.of_recording(table.decode(table.start()), 0)
    return JudgedLogs([PLANNED], [simulate(model, moving, signal, values, fitting, config.record.seed)], True)
