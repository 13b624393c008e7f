"""Devices and worlds of sim2real and of installed packages, by name; listing them imports no module."""

from collections.abc import Mapping
from importlib import metadata
from typing import Any, Final

DEVICES: Final = "sim2real.devices"
"""The entry point group of devices, see `sim2real.hardware.registry`."""
WORLDS: Final = "sim2real.worlds"
"""The entry point group of worlds, see `sim2real.robots.robot`."""
BUILT_IN: Final[Mapping[str, Mapping[str, str]]] = {
    DEVICES: {
        "dynamixel": "sim2real.hardware.dynamixel:servos",
        "feetech": "sim2real.hardware.feetech:servos",
        "unitree": "sim2real.hardware.unitree.device:legs",
    },
    WORLDS: {},
}
"""Group -> name -> ``module:callable`` of the devices and worlds of sim2real."""


def available(group: str = DEVICES) -> dict[str, Any]:
    """Return name -> source of a group; an installed package replaces the built-in entry of the same name."""
    return {**BUILT_IN[group], **{entry.name: entry for entry in metadata.entry_points(group=group)}}
