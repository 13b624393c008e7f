"""Devices and worlds by name, of sim2real and of installed packages; listing them imports no module."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any, Final

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.hardware.device import Device

DEVICES: Final = "sim2real.devices"
"""The entry point group of devices, see `load_device`."""
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


def load_device(name: str) -> Callable[..., Device]:
    """Return the function that makes a device: ``make(port, ids, drive, *, baud_rate, silence_s)``.

    The device is not opened yet. ``port`` is its connection, such as the device file of a serial port; ``ids`` are the
    motors' numbers, in the order of the joints; ``drive`` has the settings, of a type on which robot and device agree;
    ``silence_s`` is the longest time without an instruction while torque is on [s].

    Raises:
        UsageError: There is no device of this name, or it cannot be imported.
    """
    return load_entry("device", name, DEVICES, "hardware.registry.load_device")


def load_entry(what: str, name: str, group: str, contract: str) -> Callable[..., Any]:
    """Return the callable of an entry point.

    Args:
        what: Noun for errors, e.g. ``device``.
        contract: Where its protocol is defined, for the hint: a name in sim2real.

    Raises:
        UsageError: There is no entry of this name, or it cannot be imported or called.
    """
    # Find the entry among the installed packages.
    entries = available(group)
    if name not in entries:
        raise UsageError(
            f"unknown {what} {name!r}. Available: {', '.join(sorted(entries)) or 'none'}",
            hint=f"install a package with the entry point group '{group}'",
        )
    source = entries[name]
    if isinstance(source, str):
        module, _, attribute = source.partition(":")
        return getattr(importlib.import_module(module), attribute)
    # Import it.
    try:
        factory = source.load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"{what} {name!r} ({source.value}) cannot be imported: {error}") from error
    if not callable(factory):
        raise UsageError(
            f"{what} {name!r} ({source.value}) is {type(factory).__name__}, not a callable that makes a {what}",
            hint=f"see sim2real.{contract}",
        )
    return factory
