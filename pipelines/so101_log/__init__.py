"""Recorded arm of six position servos: identify loops, friction, gravity and contact."""

from sim2real.stages.config import Defaults, IdentifyConfig

DEFAULTS = Defaults(
    identify=IdentifyConfig(
        initial_state="measured",
        settle_s=0.0,
        horizon_s=8.0,
        max_delay_s=0.03,
        free_run_s=130.0,
    ),
)
