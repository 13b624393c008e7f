"""Emulated DYNAMIXEL X servos: firmware beyond the table of registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sim2real.emulation.servos import ServoEmulation, ServoFirmware
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import ALERT_BIT, StatusError

_MOVING_THRESHOLD_COUNT: Final = 10


class EmulatedServo(ServoFirmware):
    """Registers and firmware of one DYNAMIXEL X servo; see `ServoFirmware`.

    Args:
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    family = reg.FAMILY
    fixed = (reg.ID, reg.BAUD_RATE, reg.DRIVE_MODE)
    homing = reg.HOMING_OFFSET
    atomic = True
    wild_counts = (1 << 24, 1 << 31)
    answers_together = True
    misunderstandings = (StatusError.CRC, StatusError.INSTRUCTION, StatusError.DATA_LENGTH)

    def __init__(
        self,
        servo_id: int,
        model_number: int = 1060,
        return_delay_us: int = 500,
        watchdog_stops: bool | None = None,
    ) -> None:
        super().__init__(servo_id, model_number, return_delay_us)
        self.watchdog_stops = bool(reg.model(model_number).stops_alone) if watchdog_stops is None else watchdog_stops

    @property
    def answers_reads(self) -> bool:
        return self.get(reg.STATUS_RETURN_LEVEL) >= 1

    @property
    def confirms(self) -> bool:
        return self.get(reg.STATUS_RETURN_LEVEL) >= 2

    @property
    def identity(self) -> bytes:
        return reg.MODEL_NUMBER.encode(self.get(reg.MODEL_NUMBER)) + bytes((self.get(reg.FIRMWARE_VERSION),))

    @property
    def alert(self) -> int:
        return ALERT_BIT if self.get(reg.HARDWARE_ERROR_STATUS) else 0

    def driven(self) -> tuple[int, float]:
        mode = self.get(reg.OPERATING_MODE)
        if self.watchdog_stops and self.get(reg.BUS_WATCHDOG) < 0:
            return OperatingMode.PWM, 0.0
        if mode in (OperatingMode.PWM, OperatingMode.VELOCITY):
            goal = reg.GOAL_PWM if mode == OperatingMode.PWM else reg.GOAL_VELOCITY
            return mode, self.get(goal) * goal.unit
        return super().driven()

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int = 0) -> None:
        """Set the registers of present values; the tick wraps at 32768 like the servo's own counter."""
        super().refresh(position_rad, velocity_rad_s, load)
        mode, goal = self.command()
        self.put(reg.PRESENT_PWM, reg.GOAL_PWM.count(goal) if mode == OperatingMode.PWM else 0)
        self.put(reg.MOVING, abs(self.get(reg.PRESENT_VELOCITY)) > _MOVING_THRESHOLD_COUNT)
        self.put(reg.REALTIME_TICK, tick_ms % 32768)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        if length == 0 or address + length > self.family.size:
            return StatusError.ACCESS, b""
        return StatusError.NONE, bytes(self._memory[address : address + length])

    def trip_watchdog(self) -> None:
        if self.watchdog_stops:
            self.switched_on()
        self.put(reg.BUS_WATCHDOG, -1)

    def switched_on(self) -> None:
        """Set the goals to the present position."""
        self.put(reg.GOAL_PWM, 0)
        self.put(reg.GOAL_VELOCITY, 0)
        self.put(reg.GOAL_POSITION, self.get(reg.PRESENT_POSITION))

    def misfit(self, address: int, data: bytes, whole: list[Register]) -> int:
        if not data:
            return StatusError.DATA_LENGTH
        for register in whole:
            if register.address != address:
                return StatusError.ACCESS
            address, data = register.end, data[register.size :]
        cut = self.family.registers.get(address) if data else None
        return StatusError.NONE if not data else StatusError.DATA_LENGTH if cut else StatusError.ACCESS

    def refusal(self, register: Register, value: int) -> int:
        if not register.writable or (register.eeprom and self.get(reg.TORQUE_ENABLE)):
            return StatusError.ACCESS
        if register in self.fixed and value != self.get(register):
            return StatusError.RESULT_FAIL  # changes of ids, baud rates and drive modes are not emulated
        if register == reg.TORQUE_ENABLE and value and self.alert:
            return StatusError.RESULT_FAIL  # after a shutdown, torque can be switched on only after a reboot
        if not register.minimum <= value <= register.maximum:
            return StatusError.DATA_RANGE
        if register == reg.OPERATING_MODE and value not in list(OperatingMode)[1:]:
            return StatusError.DATA_RANGE
        if register in self.family.goals and self.get(reg.BUS_WATCHDOG) < 0:
            # e-Manual, Bus Watchdog(98): goals become read-only, and writing them gives a range error.
            return StatusError.DATA_RANGE
        return StatusError.DATA_LIMIT if self._beyond_limit(register, value) else StatusError.NONE

    def _beyond_limit(self, register: Register, value: int) -> bool:
        if register == reg.GOAL_PWM:
            return abs(value) > self.get(reg.PWM_LIMIT)
        if register == reg.GOAL_VELOCITY:
            return abs(value) > self.get(reg.VELOCITY_LIMIT)
        if register == reg.GOAL_POSITION and self.get(reg.OPERATING_MODE) == OperatingMode.POSITION:
            return not self.get(reg.MIN_POSITION_LIMIT) <= value <= self.get(reg.MAX_POSITION_LIMIT)
        return False


@dataclass(frozen=True)
class EmulatorConfig(ServoEmulation):
    """Settings of emulated DYNAMIXEL servos on their bus; see `Emulation` for the others.

    Args:
        model_number: The servos' model number, which determines their firmware.
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    model_number: int = 1060
    watchdog_stops: bool | None = None

    def servo(self, servo_id: int) -> EmulatedServo:
        return EmulatedServo(servo_id, self.model_number, self.return_delay_us, self.watchdog_stops)
