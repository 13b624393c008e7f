"""Servo models of all families, and the reaction of each to the death of the computer that controls it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from sim2real.hardware.device import Alone, WithoutHost


@dataclass(frozen=True)
class ServoModel:
    """A servo model.

    Args:
        stops_alone: Whether it stops when its own bus watchdog trips; None: it has no watchdog.
        source: Where that is documented, or who measured it.
    """

    name: str
    stops_alone: bool | None
    source: str

    def without_host(self, watchdog_s: float, motors: tuple[str, ...] = ()) -> WithoutHost:
        """Return the servo's reaction to the death of its host; a ``watchdog_s`` of 0 switches its bus watchdog off."""
        if self.stops_alone is None or not watchdog_s:
            why = "it has no bus watchdog" if self.stops_alone is None else "its bus watchdog is off"
            return WithoutHost(self.name, motors, Alone.GOES_ON, math.inf, self.source, why)
        does = Alone.STOPS if self.stops_alone else Alone.GOES_ON
        return WithoutHost(self.name, motors, does, watchdog_s, self.source)


def table(models: Iterable[ServoModel]) -> str:
    """Return the Markdown table of models and their reactions in docs/guides/safety.md."""
    rows = [
        (m.name, m.without_host(0.1).words.replace("after 0.1 s", "after `servo_watchdog_s`"), m.source) for m in models
    ]
    lines = [("Servo", "Reaction when the computer dies", "Source"), ("---",) * 3, *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
