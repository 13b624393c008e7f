"""The table of DYNAMIXEL X models, with the reaction of each to the death of the computer that controls it."""

from collections.abc import Mapping
from typing import Final

from sim2real.hardware.bus.models import ServoModel

_MANUAL: Final = "e-Manual, Bus Watchdog(98); not measured by us"
_FORUM: Final = "ROBOTIS reproduced it with all 330s: forum.robotis.com/t/4814 (firmware 51)"
MODELS: Final[Mapping[int, ServoModel]] = {
    1020: ServoModel("XM430-W350", True, _MANUAL),
    1030: ServoModel("XM430-W210", True, _MANUAL),
    1060: ServoModel("XL430-W250", True, _MANUAL),
    1190: ServoModel("XL330-M077", False, _FORUM),
    1200: ServoModel("XL330-M288", False, _FORUM),
    1210: ServoModel("XC330-T181", False, _FORUM),
    1220: ServoModel("XC330-T288", False, _FORUM),
    1230: ServoModel("XC330-M181", False, _FORUM),
    1240: ServoModel("XC330-M288", False, _FORUM),
}
"""Model number -> model."""


def model(number: int) -> ServoModel:
    """Return the model of a number; an unknown one counts as a model that continues without its host."""
    return MODELS.get(number, ServoModel(f"model {number}", False, "unknown model: the worst is assumed"))
