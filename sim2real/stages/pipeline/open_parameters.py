"""Identified parameters that belong to a pipeline, opened for the stages that simulate with them."""

from pathlib import Path

from sim2real.artifacts.identification import UNFINISHED, Identification
from sim2real.errors import Sim2RealError
from sim2real.robots.robot import RecordedRobot, in_world
from sim2real.stages.load import defaults_of


def open_identification(path: Path, robot: RecordedRobot) -> Identification:
    """Read what identify found for a robot.

    Raises:
        Sim2RealError: When it is missing, damaged, of another pipeline, was interrupted, or did not converge.
    """
    identification = Identification.load(path)
    check_parameters(identification, robot)
    return identification


def check_parameters(identification: Identification, robot: RecordedRobot) -> None:
    """Check that a robot can be simulated with an identification.

    Raises:
        UsageError: When the world that it was identified in is not installed.
    """
    hint = f"make them with `sim2real identify {robot.name}`"
    if identification.pipeline != robot.name:
        raise Sim2RealError(
            f"these are parameters of pipeline {identification.pipeline!r}, not of {robot.name!r}", hint=hint
        )
    if identification.posterior is None:
        ended = UNFINISHED.get(identification.verdict.status, "has no intervals")
        raise Sim2RealError(
            f"this identification {ended}: its estimates may be far off", hint=identification.verdict.next or hint
        )
    robot = in_world(robot, identification.world)
    expected = robot.identifiable(defaults_of(robot).identify.max_delay_s).parameters.names
    there = {p.name for p in identification.parameters if p.standard_error is not None}
    if lacking := [n for n in expected if n not in there]:
        raise Sim2RealError(f"these parameters hold no finite estimate of {', '.join(lacking)}", hint=hint)
