"""The robot of a pipeline, for the stages that need hardware or training."""

from __future__ import annotations

from sim2real.errors import UsageError
from sim2real.robots.base import Robot
from sim2real.stages.pipeline import Pipeline


def moving_robot(pipeline: Pipeline) -> Robot:
    """Return a pipeline's robot for the stages that need hardware or training.

    Raises:
        UsageError: When the pipeline is for recordings only, and has just what identification needs.
    """
    robot = pipeline.load()
    if not isinstance(robot, Robot):
        name = pipeline.name
        raise UsageError(
            f"pipeline {name!r} is of recordings that somebody else made: there is no robot to record, train or deploy",
            hint=f"import a recording with `sim2real import FILE --pipeline {name}`, then `sim2real identify {name}`",
        )
    return robot
