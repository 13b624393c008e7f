"""Recorded motor with an eccentric mass: identify friction, encoder and delay."""

from sim2real.stages.config import Defaults, IdentifyConfig

DEFAULTS = Defaults(
    # Windows of a second determine the delay, longer ones the friction; a kinked loss needs its kinks averaged out.
    identify=IdentifyConfig(settle_s=0.3, horizon_s=2.0, long_s=5.0, free_run_s=130.0),
)
