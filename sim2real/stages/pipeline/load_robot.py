"""The robot of a pipeline, for the stages that need hardware or training."""

from sim2real.errors import UsageError
from sim2real.robots.robot import Robot, in_world
from sim2real.stages.pipeline.pipeline import Pipeline


def moving_robot(pipeline: Pipeline, world: str | None = None) -> Robot:
    """Return a pipeline's robot for the stages that need hardware or training.

    Args:
        world: World that it is simulated in; None: its own.
    """
    robot = in_world(pipeline.load(), world)
    if not isinstance(robot, Robot):
        name = pipeline.name
        raise UsageError(
            f"pipeline {name!r} is of recordings that somebody else made: there is no robot to record, train or deploy",
            hint=f"import a recording with `sim2real import FILE --pipeline {name}`, then `sim2real identify {name}`",
        )
    return robot
