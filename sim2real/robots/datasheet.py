"""What a data sheet says about a servo, and what its firmware makes of it."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.hardware.drive import PositionDrive
from sim2real.hardware.registers import P_GAIN_UNIT, PWM_FULL_SCALE, RAD_PER_COUNT


@dataclass(frozen=True)
class DataSheet:
    """A position-controlled servo, and how it is set up.

    Attributes:
        stall: Torque at full duty and standstill [N m].
        damping: Back-EMF and viscous friction together [N m s/rad]: about ``stall`` over the speed without load.
        armature: Inertia of the rotor behind the gears [kg m^2].
        friction: Dry friction [N m].
        p_gain: Position P Gain, in counts.
        profile_rad_s: Profile Velocity [rad/s].
        model_number: What the servos say they are; a twin of the robot has that model's firmware.
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
        """Error at which the duty is full [rad]."""
        return PWM_FULL_SCALE * P_GAIN_UNIT / self.p_gain * RAD_PER_COUNT

    @property
    def gain(self) -> float:
        """Torque per error [N m/rad]."""
        return self.stall / self.full_rad

    @property
    def drive(self) -> PositionDrive:
        """How the servos are set up on the bus."""
        return PositionDrive(self.p_gain, self.profile_rad_s)
