"""A servo's data sheet, and quantities that follow from it."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.hardware.dynamixel.drive import PositionDrive
from sim2real.hardware.dynamixel.registers import P_GAIN_UNIT, PWM_FULL_SCALE, RAD_PER_COUNT


@dataclass(frozen=True)
class DataSheet:
    """Data of a position-controlled servo, and its settings.

    Attributes:
        stall: Torque at full duty and standstill [N m].
        damping: Back-EMF and viscous friction together, about ``stall`` divided by the no-load speed [N m s/rad].
        armature: Inertia of the rotor, as seen at the gear's output [kg m^2].
        friction: Dry friction [N m].
        p_gain: Position P Gain [counts].
        profile_rad_s: Profile Velocity [rad/s].
        model_number: Model number of the servos; a twin of the robot emulates that model's firmware.
    """

    stall: float
    damping: float
    armature: float
    friction: float
    p_gain: int = 800
    profile_rad_s: float = 5.0
    model_number: int = 1060

    @property
    def full_rad(self) -> float:
        """Position error at which the duty is full [rad]."""
        return PWM_FULL_SCALE * P_GAIN_UNIT / self.p_gain * RAD_PER_COUNT

    @property
    def gain(self) -> float:
        """Torque per position error [N m/rad]."""
        return self.stall / self.full_rad

    @property
    def drive(self) -> PositionDrive:
        """The drive with these settings."""
        return PositionDrive(self.p_gain, self.profile_rad_s)
