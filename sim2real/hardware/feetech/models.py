"""The table of Feetech STS models with this memory table."""

from collections.abc import Mapping
from typing import Final

from sim2real.hardware.bus.models import ServoModel

_SOURCE: Final = "Feetech, STS Series Servo Memory Table: no register for it; not measured by us"
MODELS: Final[Mapping[int, ServoModel]] = {
    777: ServoModel("STS3215", None, _SOURCE),
    2825: ServoModel("STS3250", None, _SOURCE),
}
"""Model number (LeRobot's tables.py) -> model."""
