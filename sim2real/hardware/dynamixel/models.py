"""Servo models, and what each does by itself when the computer that controls it dies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from sim2real.hardware.device import Alone, WithoutHost

_MANUAL: Final = "e-Manual, Bus Watchdog(98); not measured by us"
_FORUM: Final = "ROBOTIS reproduced it with all 330s: forum.robotis.com/t/4814 (firmware 51)"


@dataclass(frozen=True)
class ServoModel:
    """A servo model.

    Args:
        name: The model's name, as printed on the servo.
        stops_alone: Whether it stops by itself when its bus watchdog trips.
        source: How that is known.
    """

    name: str
    stops_alone: bool
    source: str

    def without_host(self, watchdog_s: float, motors: tuple[str, ...] = ()) -> WithoutHost:
        """Return what the servo does by itself when its host dies.

        Args:
            watchdog_s: The time that its bus watchdog is set to [s]; 0: off.
            motors: Names of the servos of this model.
        """
        if not watchdog_s:
            return WithoutHost(self.name, motors, Alone.GOES_ON, math.inf, self.source, "its bus watchdog is off")
        does = Alone.STOPS if self.stops_alone else Alone.GOES_ON
        return WithoutHost(self.name, motors, does, watchdog_s, self.source)


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
    """Return the model with a number; an unknown one is assumed not to stop by itself."""
    return MODELS.get(number, ServoModel(f"model {number}", False, "unknown model: the worst is assumed"))


def table() -> str:
    """Return the Markdown table of docs/guides/safety.md: the models, and what they do by themselves."""
    rows = [
        (m.name, m.without_host(0.1).words.replace("after 0.1 s", "after `servo_watchdog_s`"), m.source)
        for m in MODELS.values()
    ]
    lines = [("Servo", "By itself, when the computer dies", "Known from"), ("---",) * 3, *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
