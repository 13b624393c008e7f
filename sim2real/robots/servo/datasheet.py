"""A servo's data sheet, and quantities that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sim2real.hardware import dynamixel, feetech

if TYPE_CHECKING:
    from sim2real.hardware.dynamixel import PositionDrive
    from sim2real.hardware.feetech import StsDrive


@dataclass(frozen=True)
class DataSheet:
    """Data of a position-controlled servo, and its settings; the defaults are a DYNAMIXEL's.

    Attributes:
        stall: Torque at full duty and standstill [N m].
        damping: Back-EMF and viscous friction together, about ``stall`` divided by the no-load speed [N m s/rad].
        armature: Inertia of the rotor, as seen at the gear's output [kg m^2].
        friction: Dry friction [N m], at standstill if it decreases with speed.
        p_gain: Position P Gain [counts].
        profile_rad_s: Profile Velocity [rad/s].
        model_number: Model number of the servos; a twin of the robot emulates that model's firmware.
        stribeck_rad_s: Speed at which 1/e of the dry friction is left [rad/s]; None: it is the same at every speed.
    """

    stall: float
    damping: float
    armature: float
    friction: float
    p_gain: int = 800
    profile_rad_s: float = 5.0
    model_number: int = 1060
    stribeck_rad_s: float | None = None

    @property
    def worn(self) -> bool:
        """Whether dry friction wears off with speed."""
        return self.stribeck_rad_s is not None

    @property
    def full_rad(self) -> float:
        """Position error at which the duty is full [rad]."""
        return dynamixel.FAMILY.full_rad / self.p_gain

    @property
    def gain(self) -> float:
        """Torque per position error [N m/rad]."""
        return self.stall / self.full_rad

    @property
    def drive(self) -> PositionDrive | StsDrive:
        """The drive with these settings, for the robot's device."""
        from sim2real.hardware.dynamixel import PositionDrive

        return PositionDrive(self.p_gain, self.profile_rad_s)


@dataclass(frozen=True)
class StsSheet(DataSheet):
    """Data of a Feetech STS servo; its device is ``feetech``. Default settings are LeRobot's."""

    p_gain: int = 16
    profile_rad_s: float = math.inf
    model_number: int = 777

    @property
    def full_rad(self) -> float:
        """Position error at which the duty is full [rad]."""
        return feetech.FAMILY.full_rad / self.p_gain

    @property
    def drive(self) -> StsDrive:
        """The drive with these settings; its joints are those of a calibration."""
        from sim2real.hardware.feetech import StsDrive

        return StsDrive(self.p_gain, speed_rad_s=self.profile_rad_s)
