"""What installed packages bring beside what comes with sim2real: names only, nothing is imported."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from typing import Any, Final

DEVICES: Final = "sim2real.devices"
"""The entry point group of devices, see `sim2real.hardware.registry`."""
WORLDS: Final = "sim2real.worlds"
"""The entry point group of worlds, see `sim2real.robots.worlds`."""
OWN: Final[Mapping[str, Mapping[str, str]]] = {
    DEVICES: {
        "dynamixel": "sim2real.hardware.dynamixel.device:servos",
        "feetech": "sim2real.hardware.feetech.device:servos",
    },
    WORLDS: {},
}
"""Group -> name -> ``module:callable`` of what comes with sim2real."""


def available(group: str = DEVICES) -> dict[str, Any]:
    """Return name -> source of a group: those of installed packages before those that come with sim2real."""
    return {**OWN[group], **{entry.name: entry for entry in metadata.entry_points(group=group)}}
