"""What a robot's position servos are: their numbers on the bus, their limits, and the joints that they drive."""

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
    """Return the turns of the servo for one of the joint; a name stands for a joint without a gear."""
    return 1.0 if isinstance(joint, str) else joint.gear


@dataclass(frozen=True)
class Servos:
    """The servos on the bus, in the order of the joints.

    Attributes:
        joints: Their names, or the joints with zero, direction and gear; a zero is what the device reads there.
        ids: Numbers on the bus.
        low: Lowest goals [rad].
        high: Highest goals [rad].
        sheet: What their data sheet says, and how they are set up.
        speed: The fastest that a policy moves goals [rad/s].
        rest: Where the joints hang without torque [rad]; default: 0.
        rest_tolerance: How far from there an episode may start [rad].
        middle: What excitations are around [rad]; default: 0.
        baud_rate: Of the bus.
        device: Name of the device that they are; see `sim2real.hardware.registry`.
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
        from sim2real.hardware.joint import Joint  # for the rig: training needs names and gears alone

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
        """Where the joints hang without torque, ``(joints,)`` [rad]."""
        return np.asarray(self.rest or np.zeros(len(self.joints)), np.float64)
