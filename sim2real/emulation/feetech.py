"""Emulated Feetech servos: firmware beyond the table of registers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim2real.emulation.servos import ServoEmulation, ServoFirmware
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import OperatingMode


class StsServo(ServoFirmware):
    """Registers and firmware of one STS3215; see `ServoFirmware`.

    A value out of range, or a write to a read-only register, is dropped without an error: status packets have none for
    it. EEPROM registers accept writes at any time; a value that was written while Lock is 1 is lost at the next
    restart. Goals beyond the position limits are clipped. An instruction with a wrong checksum gets no answer, as the
    protocol has no error for it; nor does a broadcast ping of several servos, whose answers would collide.

    Two assumptions, which we did not measure, are the worst case for a driver: writing a goal switches the torque on
    (`goal_wakes`), and after an alarm the motor is off while the torque register still holds 1. Not emulated: the
    remaining torque after an overload (Protective Torque), modes other than position, a limited acceleration of the
    setpoint, currents, other ids and baud rates.

    Args:
        goal_wakes: Whether writing a goal switches the torque on.
    """

    family = reg.FAMILY
    fixed = (reg.ID, reg.BAUD_RATE)
    homing = reg.HOMING_OFFSET
    offset_sign = -1

    def __init__(
        self,
        servo_id: int,
        model_number: int = 777,
        return_delay_us: int = 500,
        goal_wakes: bool = True,
    ) -> None:
        super().__init__(servo_id, model_number, return_delay_us)
        self._goal_wakes = goal_wakes
        self._saved = bytes(self._memory)

    @property
    def confirms(self) -> bool:
        return bool(self.get(reg.RESPONSE_LEVEL))

    @property
    def alert(self) -> int:
        """The alarms, in the error byte of status packets."""
        return self.get(reg.STATUS)

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor, which is off after some alarms."""
        return (OperatingMode.OFF, 0.0) if self.alert & self.get(reg.UNLOADING) else super().command()

    def driven(self) -> tuple[int, float]:
        low, high = self.get(reg.MIN_POSITION), self.get(reg.MAX_POSITION)
        count = self.get(reg.GOAL_POSITION)
        count = min(max(count, low), high) if (low, high) != (0, 0) else count  # both limits 0: several turns
        return OperatingMode.POSITION, (count - self.offset) * reg.RAD_PER_COUNT

    def controller(self) -> tuple[int, int, float]:
        phase, count = self.get(reg.PHASE), abs(self.get(reg.GOAL_SPEED))
        unlimited = count == 0 and bool(phase & reg.PHASE_ZERO_IS_FASTEST)
        return *super().controller()[:2], math.inf if unlimited else count * reg.speed_unit_rad_s(phase)

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int = 0) -> None:
        """Set the registers of present values; there is no register of time."""
        super().refresh(position_rad, velocity_rad_s, load)
        phase = self.get(reg.PHASE)
        if not phase & reg.PHASE_FULL_ANGLE:
            self.put(reg.PRESENT_POSITION, self.get(reg.PRESENT_POSITION) % reg.COUNTS_PER_REVOLUTION)
        self.put(reg.PRESENT_SPEED, round(velocity_rad_s / reg.speed_unit_rad_s(phase)))

    def written(self, register: Register, value: int) -> None:
        """Keep values that were written without the lock over a restart; a goal may switch the torque on."""
        if register.eeprom and not self.get(reg.LOCK):
            place = slice(register.address, register.end)
            self._saved = self._saved[: place.start] + register.encode(value) + self._saved[place.stop :]
        if register == reg.GOAL_POSITION and self._goal_wakes:
            self.put(reg.TORQUE_ENABLE, 1)

    def reboot(self) -> None:
        """Restart as after a loss of power, torque off: EEPROM registers as saved, all others at their defaults."""
        self._memory[:] = self._saved
        super().reboot()
        self.put(reg.TORQUE_LIMIT, self.get(reg.MAX_TORQUE))


@dataclass(frozen=True)
class StsEmulation(ServoEmulation):
    """Settings of emulated STS3215 servos on their bus; see `ServoEmulation` for the others.

    Args:
        goal_wakes: Whether writing a goal switches the torque on, the worst case for a driver.
        homing_offset: Offset that every servo subtracts from its encoder's count [counts].
    """

    model_number: int = 777
    goal_wakes: bool = True
    homing_offset: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require({"homing_offset": (-2047, 2047)})

    def servo(self, servo_id: int) -> StsServo:
        servo = StsServo(servo_id, self.model_number, self.return_delay_us, self.goal_wakes)
        servo.put(reg.HOMING_OFFSET, self.homing_offset)
        return servo
