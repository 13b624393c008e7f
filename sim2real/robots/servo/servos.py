"""A robot's position servos: their numbers on the bus, their limits, and their joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim2real.robots.servo.datasheet import DataSheet

if TYPE_CHECKING:
    from sim2real.hardware.joint import Joint


def name_of(joint: Joint | str) -> str:
    """Return the name of a joint."""
    return joint if isinstance(joint, str) else joint.name


def gear_of(joint: Joint | str) -> float:
    """Return the turns of the servo for one of the joint; a joint that is only a name has no gear."""
    return 1.0 if isinstance(joint, str) else joint.gear


@dataclass(frozen=True)
class Servos:
    """The servos on the bus, in the order of the joints.

    Attributes:
        joints: Their names, or the joints with zero, direction and gear; a zero is the device's reading there.
        ids: Numbers on the bus.
        low: Lowest goals [rad].
        high: Highest goals [rad].
        sheet: Their data sheet and settings.
        speed: Largest speed of a policy's goals [rad/s].
        rest: Positions of the joints without torque [rad]; default: 0.
        rest_tolerance: Largest distance of an episode's start from ``rest`` [rad].
        middle: Centre of excitations [rad]; default: 0.
        baud_rate: Baud rate of the bus.
        device: Name of the device; see `sim2real.hardware.registry`.
    """

    joints: tuple[Joint | str, ...]
    ids: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    sheet: DataSheet
    speed: float = 1.5
    rest: tuple[float, ...] = ()
    rest_tolerance: float = 0.4
    middle: tuple[float, ...] = ()
    baud_rate: int = 1_000_000
    device: str = "dynamixel"

    @property
    def mounting(self) -> tuple[Joint, ...]:
        """The joints."""
        from sim2real.hardware.joint import Joint  # imported here: training needs names and gears only

        return tuple(Joint.of(joint) for joint in self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names."""
        return tuple(name_of(joint) for joint in self.joints)

    @property
    def gears(self) -> tuple[float, ...]:
        """Turns of each servo for one of its joint."""
        return tuple(gear_of(joint) for joint in self.joints)

    @property
    def at_rest(self) -> np.ndarray:
        """Positions of the joints without torque, ``(joints,)`` [rad]."""
        return np.asarray(self.rest or np.zeros(len(self.joints)), np.float64)
