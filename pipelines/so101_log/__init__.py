"""The SO-101 arm: six recorded position servos, to be identified from goals and positions."""

from sim2real.stages.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline

PIPELINE = Pipeline(
    name="so101_log",
    summary="recorded arm of six position servos: identify loops, friction, gravity and contact",
    package=__name__,
    # Forty-five parameters: a search would need thousands of generations, and rough values are available.
    identify=IdentifyConfig(
        initial_state="measured",
        settle_s=0.0,
        horizon_s=8.0,
        generations=0,
        max_delay_s=0.03,
        free_run_s=130.0,
    ),
)
