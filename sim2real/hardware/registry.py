"""Devices by name: those that come with sim2real, and those of installed packages."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from typing import Any, Final, Protocol, cast

from sim2real.errors import UsageError
from sim2real.hardware.device import Device
from sim2real.hardware.plant import load_named

ENTRY_POINT_GROUP: Final = "sim2real.devices"
OWN: Final = {"dynamixel": "sim2real.hardware.dynamixel.device:servos"}
"""Name -> ``module:callable`` of the devices that come with sim2real."""


class DeviceFactory(Protocol):
    """What a device's name stands for: makes the device, not opened yet."""

    def __call__(self, port: str, ids: Sequence[Any], drive: Any, *, baud_rate: int, silence_s: float) -> Device:
        """Return the device.

        Args:
            port: What it is connected to, e.g. a serial port's device file.
            ids: The motors' numbers, in the order of the joints.
            drive: How the motors are driven: settings that the robot and the device agree on.
            baud_rate: Bits per second.
            silence_s: Longest time without an instruction while torque is on [s].
        """
        ...


def available() -> dict[str, Any]:
    """Return name -> source of all devices: those of installed packages before those that come with sim2real."""
    return {**OWN, **{entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)}}


def load_device(name: str) -> DeviceFactory:
    """Return what makes the device of a name.

    Raises:
        UsageError: There is no such device, or what its entry point names cannot be imported or called.
    """
    found = available()
    if name not in found:
        raise UsageError(
            f"unknown device {name!r}. Available: {', '.join(sorted(found))}",
            hint=f"install a package with the entry point group '{ENTRY_POINT_GROUP}'",
        )
    source = found[name]
    if isinstance(source, str):
        return load_named(source, "device")
    try:
        factory = source.load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"device {name!r} ({source.value}) cannot be imported: {error}") from error
    if not callable(factory):
        raise UsageError(
            f"device {name!r} ({source.value}) is {type(factory).__name__}, not a callable that makes a Device",
            hint="see sim2real.hardware.registry.DeviceFactory",
        )
    return cast(DeviceFactory, factory)
