"""Recorded DYNAMIXEL XL330 lifting a mass: identify motor, gears and friction."""

from sim2real.stages.config import Defaults, IdentifyConfig

DEFAULTS = Defaults(
    # The loss has kinks wherever the arm sticks or breaks loose: short windows, and differences wide enough to look
    # past them. Rough values are available; a search of as many seconds ends elsewhere with every seed.
    identify=IdentifyConfig(
        initial_state="measured",
        settle_s=0.0,
        horizon_s=0.6,
        spacing_s=0.3,
        difference=0.03,
        max_delay_s=0.01,
        reach=1.0,
        free_run_s=10.0,
    ),
)
