"""The disk pendulum: an eccentric mass on a DC motor, swung up by a policy."""

from sim2real.stages.pipeline import Pipeline

PIPELINE = Pipeline(
    name="pendulum",
    summary="disk pendulum on a DC motor: swing it up and keep it upright",
    package=__name__,
)
