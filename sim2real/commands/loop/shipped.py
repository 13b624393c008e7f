"""Whether a run trains a policy, or deploys the one that its pipeline ships."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim2real.stages.pipeline.pipeline import Pipeline


def why_shipped(pipeline: Pipeline) -> str:
    """Return why a run deploys the policy that its pipeline ships; "" if it trains one."""
    if not pipeline.shipped.is_dir():
        return ""
    import jax

    from sim2real.robots.robot import Robot

    robot = pipeline.load()
    if not isinstance(robot, Robot) or not robot.model.needs_gpu or jax.default_backend() == "gpu":
        return ""
    return (
        f"a policy for {pipeline.name} takes hours to train without a GPU, and JAX has none here: the run deploys the "
        "policy that the pipeline ships"
    )
