"""The disk pendulum: an eccentric mass on a DC motor, swung up by a policy."""

from sim2real.stages.config import RecordConfig
from sim2real.stages.pipeline.pipeline import Pipeline

PIPELINE = Pipeline(
    name="pendulum",
    summary="disk pendulum on a DC motor: swing it up and keep it upright",
    package=__name__,
    scene="scene",
    # Around the pendulum's own 1.7 Hz, where 2 V swing it far enough to separate damping from friction.
    record=RecordConfig(amplitude=2.0, low_hz=0.7, high_hz=2.0),
)
