"""Drives of servos, by voltage or by joint angle: conversion of commands to goals on the bus, and of readings back."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import POSITION, VOLTAGE, CommandKind, OperatingMode, Reading, Transaction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import ServoBus
from sim2real.hardware.safety.following import MOST_SHARE, RESPONSE_S, SLOW_RAD_S, Following


class Drive(ABC):
    """A way to drive servos. Commands are float64 arrays of shape (n,), in the order of the bus's ids."""

    mode: ClassVar[OperatingMode]
    kind: ClassVar[CommandKind]

    def check(self, servos: int) -> None:
        """Check the number of servos before the port is opened; raise UsageError if the drive is for another one."""
        del servos

    def prepare(self, bus: ServoBus) -> None:
        """Write the servos' settings, with torque off; raise HardwareLost if a servo does not keep them."""
        del bus

    @property
    def following(self) -> Following | None:
        """How joints follow their commands; here: not known."""
        return None

    def reach(self, bus: ServoBus) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command that the servos follow, each ``(n,)``; inf: `send` refuses more."""
        return np.full(len(bus.ids), -np.inf), np.full(len(bus.ids), np.inf)

    @abstractmethod
    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return the command that the servos follow right after torque goes on."""

    @abstractmethod
    def send(self, bus: ServoBus, command: np.ndarray) -> Transaction:
        """Write a command to the servos."""

    def reading(self, reading: Reading) -> Reading:
        """Return a measurement with positions in this drive's angles; here unchanged."""
        return reading


@dataclass(frozen=True)
class VoltageDrive(Drive):
    """Servos in PWM mode, commanded in volts, at rest 0 V. Angles are measured from each encoder's zero [rad].

    Args:
        supply_v: Voltage of a motor at full PWM [V].
    """

    supply_v: float
    mode = OperatingMode.PWM
    kind = VOLTAGE

    def __post_init__(self) -> None:
        if not 0.0 < self.supply_v < math.inf:
            raise UsageError(f"supply_v = {self.supply_v} must be larger than 0")

    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return zero volts."""
        return np.zeros(len(bus.ids))

    def send(self, bus: ServoBus, command: np.ndarray) -> Transaction:
        """Write voltages [V]."""
        return bus.write_goal_pwm({i: float(v) / self.supply_v for i, v in zip(bus.ids, command, strict=True)})


@dataclass(frozen=True)
class PositionDrive(Drive):
    """Servos in position mode, commanded in joint angles [rad]; at rest they hold their position.

    A joint's angle is 0 where its encoder reads `zero_count`. The servos accept goals within one revolution, counts 0
    to 4095, so a joint with its zero at the centre moves between -pi and pi.

    Args:
        p_gain: Position P Gain of every servo [counts].
        profile_velocity_rad_s: Speed at which a servo's setpoint moves to its goal [rad/s], rounded to a multiple of
            0.024 rad/s of at least one; inf: the setpoint is the goal.
        d_gain: Position D Gain of every servo [counts].
        zero_count: Encoder count at the joint's zero: one for all servos, or one per servo.
    """

    p_gain: int
    profile_velocity_rad_s: float
    d_gain: int = 0
    zero_count: int | tuple[int, ...] = 2048
    mode = OperatingMode.POSITION
    kind = POSITION

    def __post_init__(self) -> None:
        for register, value in self._settings().items():
            if not register.minimum <= value <= register.maximum:
                limits = f"[{register.minimum}, {register.maximum}]"
                raise UsageError(f"position drive: {register.name} = {value} is outside {limits}")
        counts = np.asarray(self.zero_count)
        if np.any(counts < 0) or np.any(counts >= reg.COUNTS_PER_REVOLUTION):
            raise UsageError(f"position drive: zero_count = {self.zero_count} is outside the encoder's revolution")

    def check(self, servos: int) -> None:
        """Refuse a wrong number of zero counts."""
        if isinstance(self.zero_count, tuple) and len(self.zero_count) != servos:
            raise UsageError(f"position drive: {len(self.zero_count)} zero counts for {servos} servos")

    def prepare(self, bus: ServoBus) -> None:
        """Write gains and profile, which a servo loses without power, and read them back."""
        for servo_id in bus.ids:
            drive_mode = bus.read(servo_id, reg.DRIVE_MODE)
            if drive_mode & ~reg.DRIVE_REVERSED:
                bus.write(servo_id, reg.DRIVE_MODE, drive_mode & reg.DRIVE_REVERSED)
            for register, value in self._settings().items():
                bus.write(servo_id, register, value)
                bus.link.require(servo_id, register, value)

    @property
    def following(self) -> Following | None:
        """How joints follow their goals: near the limit, a servo pushes with nearly all of its torque."""
        if not self.p_gain:
            return None
        full_rad = reg.full_torque_error_rad(self.p_gain)
        return Following(MOST_SHARE * full_rad, RESPONSE_S, min(SLOW_RAD_S, 0.5 * self.profile_velocity_rad_s))

    def reach(self, bus: ServoBus) -> tuple[np.ndarray, np.ndarray]:
        """Return the servos' own position limits, and half a count, which a goal is rounded by [rad].

        A servo ignores a goal beyond them, and does so silently when several are commanded at once.
        """
        slack = reg.RAD_PER_COUNT / 2
        return self._angle(bus, reg.MIN_POSITION_LIMIT) - slack, self._angle(bus, reg.MAX_POSITION_LIMIT) + slack

    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return the angles that the servos hold [rad]: their positions when torque went on."""
        # Read from the goals, not from the positions: a load pulls the joints off their goals, a little more each time.
        return self._angle(bus, reg.GOAL_POSITION)

    def send(self, bus: ServoBus, command: np.ndarray) -> Transaction:
        """Write joint angles [rad]."""
        angles = command + self._zero_rad
        return bus.write_goal_position({i: float(a) for i, a in zip(bus.ids, angles, strict=True)})

    def reading(self, reading: Reading) -> Reading:
        """Return the measurement with joint angles [rad]."""
        return replace(reading, position_rad=reading.position_rad - self._zero_rad)

    @property
    def _zero_rad(self) -> np.ndarray:
        return np.asarray(self.zero_count) * reg.RAD_PER_COUNT

    def _angle(self, bus: ServoBus, register: Register) -> np.ndarray:
        """Return a position register of each servo as joint angles, shape (n,) [rad]."""
        return np.array([bus.read(servo_id, register) for servo_id in bus.ids]) * reg.RAD_PER_COUNT - self._zero_rad

    def _settings(self) -> dict[Register, int]:
        if not self.profile_velocity_rad_s > 0.0:
            raise UsageError(
                f"position drive: profile_velocity_rad_s = {self.profile_velocity_rad_s} must be larger than 0",
                hint="inf switches the profile off",
            )
        unlimited = math.isinf(self.profile_velocity_rad_s)  # the register's 0 means unlimited: never round to it
        velocity = 0 if unlimited else max(1, reg.count_from_rad_s(self.profile_velocity_rad_s))
        return {
            reg.POSITION_P_GAIN: self.p_gain,
            reg.POSITION_I_GAIN: 0,
            reg.POSITION_D_GAIN: self.d_gain,
            reg.PROFILE_ACCELERATION: 0,
            reg.PROFILE_VELOCITY: velocity,
        }
