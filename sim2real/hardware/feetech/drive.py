"""Gains and limits with which Feetech servos follow a position, and their registers."""

import math
from dataclasses import dataclass

from sim2real.errors import UsageError
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint


@dataclass(frozen=True)
class StsDrive:
    """Gains and limits with which the servos follow a position.

    Args:
        p_gain: P gain; LeRobot uses 16.
        speed_rad_s: Speed at which a servo's setpoint moves to its goal; inf: the setpoint is the goal.
        acceleration_rad_s2: Acceleration of the setpoint, rounded to a multiple of 0.15 rad/s^2; inf: no limit.
        torque: Largest fraction of a servo's torque, in (0, 1].
        joints: The joints, e.g. from `read_calibration`; a servo without one gets a joint with its zero at 2048 counts.
    """

    p_gain: int = 16
    d_gain: int = 32
    i_gain: int = 0
    speed_rad_s: float = math.inf
    acceleration_rad_s2: float = math.inf
    torque: float = 1.0
    joints: tuple[CalibratedJoint, ...] = ()

    def __post_init__(self) -> None:
        for name, register in (("p_gain", reg.P_GAIN), ("d_gain", reg.D_GAIN), ("i_gain", reg.I_GAIN)):
            if not register.minimum <= getattr(self, name) <= register.maximum:
                raise UsageError(f"{name} = {getattr(self, name)} is outside [{register.minimum}, {register.maximum}]")
        for name in ("speed_rad_s", "acceleration_rad_s2"):
            if not getattr(self, name) > 0.0:
                raise UsageError(f"{name} = {getattr(self, name)} must be larger than 0", hint="inf: no limit")
        if not 0.0 < self.torque <= 1.0:
            raise UsageError(f"torque = {self.torque} is no fraction in (0, 1]")

    def registers(self, phase: int) -> dict[Register, int]:
        """Return the registers' values [counts] for a servo whose register Phase holds `phase`."""
        limit = reg.ACCELERATION.maximum
        acceleration = self.acceleration_rad_s2 / (reg.ACCELERATION_UNIT * reg.RAD_PER_COUNT)
        # Goal Speed 0 means "stop" for some servos: the smallest value is 1, and the largest their top speed.
        fastest = 0 if phase & reg.PHASE_ZERO_IS_FASTEST else reg.FASTEST_COUNTS_PER_S
        speed = self.speed_rad_s / reg.speed_unit_rad_s(phase)
        return {
            reg.P_GAIN: self.p_gain,
            reg.D_GAIN: self.d_gain,
            reg.I_GAIN: self.i_gain,
            reg.ACCELERATION: 0 if acceleration > limit else max(1, round(acceleration)),
            reg.GOAL_SPEED: fastest if speed > reg.GOAL_SPEED.maximum else max(1, round(speed)),
            reg.TORQUE_LIMIT: round(self.torque * reg.LOAD_FULL_SCALE),
        }
