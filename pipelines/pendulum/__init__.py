"""Disk pendulum on a DC motor: swing it up and keep it upright."""

from sim2real.stages.config import Defaults, RecordConfig

DEFAULTS = Defaults(
    # Around the pendulum's own 1.7 Hz, where 2 V swing it far enough to separate damping from friction.
    record=RecordConfig(amplitude=2.0, low_hz=0.7, high_hz=2.0),
)
