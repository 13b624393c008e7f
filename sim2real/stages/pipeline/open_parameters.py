"""Identified parameters that belong to a pipeline, opened for the stages that simulate with them."""

from pathlib import Path

from sim2real.artifacts.identification import UNFINISHED, Identification
from sim2real.errors import Sim2RealError
from sim2real.robots.robot import in_world
from sim2real.stages.pipeline.pipeline import Pipeline


def open_identification(path: Path, pipeline: Pipeline) -> Identification:
    """Read what identify found for a pipeline.

    Args:
        pipeline: The robot that it must be of.

    Raises:
        Sim2RealError: When it is missing, damaged, of another pipeline, was interrupted, or did not converge.
    """
    identification = Identification.load(path)
    check_parameters(identification, pipeline)
    return identification


def check_parameters(identification: Identification, pipeline: Pipeline) -> None:
    """Check that a pipeline can be simulated with an identification.

    Raises:
        UsageError: When the world that it was identified in is not installed.
    """
    hint = f"make them with `sim2real identify {pipeline.name}`"
    if identification.pipeline != pipeline.name:
        raise Sim2RealError(
            f"these are parameters of pipeline {identification.pipeline!r}, not of {pipeline.name!r}", hint=hint
        )
    if identification.posterior is None:
        ended = UNFINISHED.get(identification.verdict.status, "has no intervals")
        raise Sim2RealError(
            f"this identification {ended}: its estimates may be far off", hint=identification.verdict.next or hint
        )
    robot = in_world(pipeline.load(), identification.world)
    expected = robot.identifiable(pipeline.identify.max_delay_s).parameters.names
    there = {p.name for p in identification.parameters if p.standard_error is not None}
    if lacking := [n for n in expected if n not in there]:
        raise Sim2RealError(f"these parameters hold no finite estimate of {', '.join(lacking)}", hint=hint)
