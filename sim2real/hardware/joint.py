"""Mountings of joints on their motors: conversion between the encoder's side and the joint's side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.device import Device, Reading

_POWER_OF_GEAR: Final = {"rad": 1, "rad/s": 1, "N m": -1, "V": 0, "A": 0, "1": 0, "N m/rad": -2, "N m s/rad": -2}
"""Unit -> n: the motor's value is gear ** n times the joint's, as the motor turns faster, with less torque."""
_UNDIRECTED: Final = ("N m/rad", "N m s/rad")
"""Units of gains, whose sign does not change with the direction."""


T = TypeVar("T", "float", "np.ndarray")


@dataclass(frozen=True)
class Joint:
    """A joint, and its mounting on the encoder of its motor.

    Attributes:
        zero_rad: The encoder's angle at the joint's angle 0, as the device reports it [rad].
        direction: 1 where both turn the same way, -1 where they turn against each other.
        gear: Turns of the encoder for one turn of the joint.
    """

    name: str
    zero_rad: float = 0.0
    direction: int = 1
    gear: float = 1.0

    @classmethod
    def of(cls, joint: Joint | str) -> Joint:
        """Return a joint; a name stands for a joint whose angle is its encoder's."""
        return joint if isinstance(joint, Joint) else cls(joint)

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise UsageError(f"joint {self.name!r}: direction = {self.direction!r} is neither 1 nor -1")
        if not (math.isfinite(self.gear) and self.gear > 0):
            raise UsageError(
                f"joint {self.name!r}: gear = {self.gear!r} is not a number above 0",
                hint="direction = -1 means that encoder and joint turn against each other",
            )
        if not math.isfinite(self.zero_rad):
            raise UsageError(f"joint {self.name!r}: zero_rad = {self.zero_rad!r} is not a finite angle")

    @property
    def is_plain(self) -> bool:
        """Whether the joint's angle is the encoder's."""
        return self.zero_rad == 0.0 and self.direction == 1 and self.gear == 1.0

    def angle(self, encoder_rad: T) -> T:
        """Return the joint's angle [rad] for an encoder's, of any shape."""
        return self.direction * (encoder_rad - self.zero_rad) / self.gear

    def encoder(self, angle_rad: T) -> T:
        """Return the encoder's angle [rad] at an angle of the joint, of any shape."""
        return self.zero_rad + self.direction * self.gear * angle_rad

    def speed(self, encoder_rad_s: T) -> T:
        """Return the joint's speed [rad/s] for the encoder's, of any shape."""
        return self.direction * encoder_rad_s / self.gear


class Mounting:
    """The mountings of all joints of a device: converts commands and readings between joints and motors.

    The unit of a command determines its conversion. Of voltages, currents and duties (`V`, `A`, `1`) only the sign
    changes. Gears are assumed to be lossless.

    Attributes:
        gear: Turns of each motor for one turn of its joint, ``(n,)``.

    Args:
        joints: One per motor, in the device's order; none: joints have the angles of their encoders.
        device: The device; it need not be open.

    Raises:
        UsageError: There is another number of joints than of motors, or the unit of the device's commands or loads has
            no conversion.
    """

    def __init__(self, joints: Sequence[Joint], device: Device) -> None:
        mounted = tuple(joints) or tuple(Joint(name) for name in device.motors)
        if len(mounted) != len(device.motors):
            names = ", ".join(joint.name for joint in mounted)
            raise UsageError(f"there are {len(mounted)} joints ({names}) for {len(device.motors)} motors")
        kind = device.commanded
        rows = np.array([(joint.zero_rad, joint.direction, joint.gear) for joint in mounted], np.float64)
        self._zero, direction, gear = rows.reshape(-1, 3).T
        self._turns, self.gear = direction * gear, gear
        # Plain joints need no conversion, so their units may be any.
        plain = all(joint.is_plain for joint in mounted)

        def factor(unit: str, what: str) -> np.ndarray:
            if plain:
                return np.ones(len(mounted))
            power = _power(unit, what)
            return (1.0 if unit in _UNDIRECTED else direction) * gear**power

        self._load = factor(device.load_unit, "loads")
        self._factor = np.stack([factor(unit, kind.name) for unit in kind.units], axis=-1)
        self._offset = np.stack([self._zero * (unit == "rad") for unit in kind.units], axis=-1)
        if not kind.columns:
            self._factor, self._offset = self._factor[:, 0], self._offset[:, 0]

    def to_motors(self, command: np.ndarray) -> np.ndarray:
        """Return the motors' command for a command of the joints, ``(n,)`` or ``(n, k)``."""
        return self._offset + self._factor * command

    def to_joints(self, command: np.ndarray) -> np.ndarray:
        """Return the joints' command for a command of the motors, ``(n,)`` or ``(n, k)``."""
        return (command - self._offset) / self._factor

    def limits(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints' lowest and highest command for those of the motors, each ``(n,)`` or ``(n, k)``."""
        ends = self.to_joints(low), self.to_joints(high)
        return np.minimum(*ends), np.maximum(*ends)  # a direction of -1 swaps them

    def reading(self, reading: Reading) -> Reading:
        """Convert a reading of the motors to angles, speeds and loads of the joints."""
        return replace(
            reading,
            position_rad=(reading.position_rad - self._zero) / self._turns,
            velocity_rad_s=reading.velocity_rad_s / self._turns,
            load=reading.load / self._load,
        )


def _power(unit: str, what: str) -> int:
    if unit not in _POWER_OF_GEAR:
        raise UsageError(
            f"{what} in {unit!r} cannot be converted between motors and joints with a zero, a direction or a gear. "
            f"Units: {', '.join(_POWER_OF_GEAR)}",
            hint="convert them in the device, and give its joints no zero, direction or gear",
        )
    return _POWER_OF_GEAR[unit]
