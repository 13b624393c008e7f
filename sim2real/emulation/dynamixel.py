"""Emulated DYNAMIXEL X servos: their registers and firmware, and their bus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from sim2real.emulation.bus import BusEmulation, InstructedBus, Request
from sim2real.emulation.firmware import ServoFirmware
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.models import model
from sim2real.hardware.dynamixel.protocol import ALERT_BIT, PROTOCOL, StatusError

_MOVING_THRESHOLD_COUNT: Final = 10
_OVERLOAD_BIT: Final = 5
_FIXED: Final = (reg.ID, reg.BAUD_RATE, reg.DRIVE_MODE)
_MOTION: Final = (reg.TORQUE_ENABLE, *reg.TABLE.goals)


class EmulatedServo(ServoFirmware):
    """Registers and firmware of one DYNAMIXEL X servo; see `ServoFirmware`.

    Args:
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    table = reg.TABLE

    def __init__(
        self,
        servo_id: int,
        model_number: int = 1060,
        return_delay_us: int = 500,
        encoder_counts: int = 4096,
        watchdog_stops: bool | None = None,
    ) -> None:
        super().__init__(servo_id, model_number, return_delay_us, encoder_counts)
        self.watchdog_stops = bool(model(model_number).stops_alone) if watchdog_stops is None else watchdog_stops

    @property
    def answers_reads(self) -> bool:
        """Whether it answers when it is read."""
        return self.get(reg.STATUS_RETURN_LEVEL) >= 1

    @property
    def confirms(self) -> bool:
        """Whether it answers when it is written."""
        return self.get(reg.STATUS_RETURN_LEVEL) >= 2

    @property
    def identity(self) -> bytes:
        """Model number and firmware version."""
        return reg.MODEL_NUMBER.encode(self.get(reg.MODEL_NUMBER)) + bytes((self.get(reg.FIRMWARE_VERSION),))

    @property
    def alert(self) -> int:
        """The alert bit of status packets: 0x80 while a hardware error is present, else 0."""
        return ALERT_BIT if self.get(reg.HARDWARE_ERROR_STATUS) else 0

    def command(self) -> tuple[int, float]:
        """Return mode and goal: PWM and a fraction in [-1, 1], POSITION [rad], VELOCITY [rad/s], or OFF and 0."""
        # Torque off and a tripped watchdog come before the operating mode.
        if not self.get(reg.TORQUE_ENABLE):
            return OperatingMode.OFF, 0.0
        mode = self.get(reg.OPERATING_MODE)
        if self.watchdog_stops and self.get(reg.BUS_WATCHDOG) == reg.WATCHDOG_TRIPPED:
            return OperatingMode.PWM, 0.0
        if mode == OperatingMode.PWM:
            return mode, reg.fraction_from_pwm(self.get(reg.GOAL_PWM))
        if mode == OperatingMode.VELOCITY:
            return mode, reg.rad_s_from_count(self.get(reg.GOAL_VELOCITY))
        goal_count = self.get(reg.GOAL_POSITION) - self.get(reg.HOMING_OFFSET)
        return OperatingMode.POSITION, reg.rad_from_count(goal_count)

    def controller(self) -> tuple[int, int, float]:
        """Return P gain and D gain of the position controller [counts], and its profile velocity [rad/s]."""
        count = self.get(reg.PROFILE_VELOCITY)
        profile_velocity_rad_s = reg.rad_s_from_count(count) if count else math.inf
        return self.get(reg.POSITION_P_GAIN), self.get(reg.POSITION_D_GAIN), profile_velocity_rad_s

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int) -> None:
        """Set the Present registers from a measurement of the plant.

        Args:
            position_rad: Angle from the encoder's zero [rad].
            load: Fraction of the largest load, in [-1, 1].
            tick_ms: Time since power-up [ms]; wraps at 32768 like the servo's own counter.
        """
        # Round the angle to the encoder's resolution, then to counts of the register.
        step_rad = 2.0 * math.pi / self._encoder_counts
        count = reg.count_from_rad(round(position_rad / step_rad) * step_rad)
        velocity_count = reg.count_from_rad_s(velocity_rad_s)
        mode, goal = self.command()
        self.put(reg.PRESENT_POSITION, count + self.get(reg.HOMING_OFFSET))
        self.put(reg.PRESENT_VELOCITY, velocity_count)
        self.put(reg.PRESENT_LOAD, round(max(-1.0, min(1.0, load)) * reg.LOAD_FULL_SCALE))
        self.put(reg.PRESENT_PWM, reg.pwm_from_fraction(goal) if mode == OperatingMode.PWM else 0)
        self.put(reg.MOVING, abs(velocity_count) > _MOVING_THRESHOLD_COUNT)
        self.put(reg.REALTIME_TICK, tick_ms % 32768)

    def read(self, address: int, length: int) -> tuple[StatusError, bytes]:
        """Return the error and the bytes of the answer to a READ."""
        if length == 0 or address + length > reg.TABLE.size:
            return StatusError.ACCESS, b""
        return StatusError.NONE, bytes(self._memory[address : address + length])

    def write(self, address: int, data: bytes) -> tuple[StatusError, bool]:
        """Write all registers, or none if there is an error; return it, and whether `command` may have changed."""
        # Check every register before the first is written.
        pairs: list[tuple[Register, int]] = []
        error = self._split(address, data, pairs)
        for register, value in pairs:
            error = error or self._refusal(register, value)
        if error:
            return error, False
        # When torque goes on, the goals are set to rest.
        torque_was_on = self.get(reg.TORQUE_ENABLE)
        for register, value in pairs:
            self.put(register, value)
        torque_on = self.get(reg.TORQUE_ENABLE)
        if torque_on and not torque_was_on:
            self._rest_goals()
        moves = any(register in _MOTION for register, _ in pairs) and bool(torque_on or torque_was_on)
        return StatusError.NONE, moves

    def action(self) -> tuple[StatusError, bool]:
        """Carry out the stored write; without one, the result is an instruction error."""
        if self._registered is None:
            return StatusError.INSTRUCTION, False
        stored, self._registered = self._registered, None
        return self.write(*stored)

    def watchdog_deadline_ns(self) -> int | None:
        """Return the time at which the bus watchdog trips without an instruction; None if it is off."""
        value = self.get(reg.BUS_WATCHDOG)
        if value <= 0 or not self.get(reg.TORQUE_ENABLE):
            return None
        return self.heard_ns + round(value * reg.WATCHDOG_UNIT_S * 1e9)

    def trip_watchdog(self) -> None:
        """Trip the bus watchdog: it refuses goals until it is set to 0, and the motor stops on some models."""
        if self.watchdog_stops:
            self._rest_goals()
        self.put(reg.BUS_WATCHDOG, reg.WATCHDOG_TRIPPED)

    def overload(self) -> None:
        """Shut down as after an overload: torque off, and an error bit set until reboot."""
        self.put(reg.HARDWARE_ERROR_STATUS, 1 << _OVERLOAD_BIT)
        self.put(reg.TORQUE_ENABLE, 0)

    def _rest_goals(self) -> None:
        self.put(reg.GOAL_PWM, 0)
        self.put(reg.GOAL_VELOCITY, 0)
        self.put(reg.GOAL_POSITION, self.get(reg.PRESENT_POSITION))

    def _split(self, address: int, data: bytes, pairs: list[tuple[Register, int]]) -> StatusError:
        """Split written bytes into whole registers and append these to `pairs`."""
        if not data:
            return StatusError.DATA_LENGTH
        while data:
            register = reg.TABLE.registers.get(address)
            if register is None:
                return StatusError.ACCESS
            if len(data) < register.size:
                return StatusError.DATA_LENGTH
            pairs.append((register, register.decode(data[: register.size])))
            address, data = register.end, data[register.size :]
        return StatusError.NONE

    def _refusal(self, register: Register, value: int) -> StatusError:
        """Return the firmware's reason to refuse a value, or NONE."""
        if not register.writable or (register.eeprom and self.get(reg.TORQUE_ENABLE)):
            return StatusError.ACCESS
        if register in _FIXED and value != self.get(register):
            return StatusError.RESULT_FAIL  # not emulated: other ids, baud rates and drive modes
        if register == reg.TORQUE_ENABLE and value and self.alert:
            return StatusError.RESULT_FAIL  # after a shutdown, torque can be switched on only after a reboot
        if not register.minimum <= value <= register.maximum:
            return StatusError.DATA_RANGE
        if register == reg.OPERATING_MODE and value not in list(OperatingMode)[1:]:
            return StatusError.DATA_RANGE
        if register in reg.TABLE.goals and self.get(reg.BUS_WATCHDOG) == reg.WATCHDOG_TRIPPED:
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


class EmulatedBus(InstructedBus[EmulatedServo, "EmulatorConfig"]):
    """Emulated DYNAMIXEL servos on a bus, driving a plant; see `InstructedBus`."""

    form = PROTOCOL
    present = (reg.PRESENT_PWM, reg.PRESENT_POSITION)
    wild_counts = (1 << 24, 1 << 31)

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._handlers[Instruction.BULK_READ] = self._bulk_read

    def make_servo(self, servo_id: int) -> EmulatedServo:
        """Return a servo with this bus's settings."""
        c = self.config
        return EmulatedServo(servo_id, c.model_number, c.return_delay_us, c.encoder_counts, c.watchdog_stops)

    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""
        if request.packet.code != Instruction.STATUS:
            super().execute(request)

    def _misunderstand(self, servo: EmulatedServo, request: Request) -> None:
        """Answer an instruction with its error."""
        self._answer(servo, request, StatusError.INSTRUCTION if request.packet.intact else StatusError.CRC)

    def _misread(self, servo: EmulatedServo, request: Request) -> None:
        """Answer a READ of a wrong length with an error."""
        self._confirm(servo, request, StatusError.DATA_LENGTH)

    def _bulk_read(self, request: Request, targets: list[EmulatedServo]) -> None:
        del targets
        parameters = request.packet.parameters
        for i in range(0, len(parameters) - 4, 5):
            if parameters[i] in self.servos:
                self._answer_read(self.servos[parameters[i]], request, i + 1)


@dataclass(frozen=True)
class EmulatorConfig(BusEmulation):
    """Settings of emulated DYNAMIXEL servos on their bus; see `Emulation` for the others.

    Args:
        model_number: The servos' model number; their firmware behaves as that of the model.
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    bus_type = EmulatedBus

    model_number: int = 1060
    watchdog_stops: bool | None = None
