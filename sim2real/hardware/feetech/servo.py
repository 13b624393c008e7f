"""One emulated servo: its registers, and the rules of its firmware."""

import math
from typing import Final

from sim2real.hardware.emulation.firmware import ServoFirmware
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.plant import OperatingMode

STALL_CURRENT_A: Final = 2.7  # data sheet of the STS3215-C018, 12 V
_MOVING_COUNTS_PER_S: Final = 50
_FIXED: Final = (reg.ID, reg.BAUD_RATE)
_MOTION: Final = (reg.TORQUE_ENABLE, *reg.TABLE.goals, reg.OPERATING_MODE)


class StsServo(ServoFirmware):
    """Registers and firmware of one STS3215, without time, bus and physics.

    A value out of range is dropped without an error, as its status packets carry none; so is a write to a read-only
    register. EEPROM registers accept writes at any time; a value that was written while Lock is 1 is lost at the next
    restart. Goals beyond the position limits are cut to them.

    Two assumptions, not measured by us, are the worse case for a driver: writing a goal switches the torque on
    (`goal_wakes`), and after an alarm the motor is off while the torque register still holds 1. Not emulated: the
    remaining torque after an overload (Protective Torque), the step mode, other ids and baud rates.

    Args:
        goal_wakes: Whether writing a goal switches the torque on.
        alarms: The alarms that `overload` sets; bits of the error byte.
    """

    table = reg.TABLE

    def __init__(
        self,
        servo_id: int,
        model_number: int = 777,
        return_delay_us: int = 500,
        encoder_counts: int = reg.COUNTS_PER_REVOLUTION,
        goal_wakes: bool = True,
        alarms: int = 1 << 5,
    ) -> None:
        super().__init__(servo_id, model_number, return_delay_us, encoder_counts)
        self._goal_wakes = goal_wakes
        self._faults = alarms
        self._saved = bytes(self._memory)

    @property
    def confirms(self) -> bool:
        """Whether it answers when it is written."""
        return bool(self.get(reg.RESPONSE_LEVEL))

    @property
    def alert(self) -> int:
        """The error byte of its status packets: the alarms."""
        return self.get(reg.STATUS)

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor; see `Firmware.command`."""
        if not self.get(reg.TORQUE_ENABLE) or self.alert & self.get(reg.UNLOADING):
            return OperatingMode.OFF, 0.0
        mode = self.get(reg.OPERATING_MODE)
        if mode == reg.Mode.PWM:
            return OperatingMode.PWM, self.get(reg.GOAL_TIME) / reg.LOAD_FULL_SCALE
        if mode == reg.Mode.VELOCITY:
            return OperatingMode.VELOCITY, self.get(reg.GOAL_SPEED) * reg.speed_unit_rad_s(self.get(reg.PHASE))
        low, high = self.get(reg.MIN_POSITION), self.get(reg.MAX_POSITION)
        count = self.get(reg.GOAL_POSITION)
        count = min(max(count, low), high) if (low, high) != (0, 0) else count  # 0 and 0: several turns
        return OperatingMode.POSITION, (count + self.get(reg.HOMING_OFFSET)) * reg.RAD_PER_COUNT

    def controller(self) -> tuple[int, int, float]:
        """Return P gain and D gain of the position controller [counts], and the setpoint's top speed [rad/s]."""
        phase, count = self.get(reg.PHASE), abs(self.get(reg.GOAL_SPEED))
        unlimited = count == 0 and bool(phase & reg.PHASE_ZERO_IS_FASTEST)
        speed_rad_s = math.inf if unlimited else count * reg.speed_unit_rad_s(phase)
        return self.get(reg.P_GAIN), self.get(reg.D_GAIN), speed_rad_s

    def acceleration_rad_s2(self) -> float:
        """Return the acceleration of the setpoint [rad/s^2]."""
        count = self.get(reg.ACCELERATION)
        return count * reg.ACCELERATION_UNIT * reg.RAD_PER_COUNT if count else math.inf

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int = 0) -> None:
        """Set the Present registers from a measurement of the plant.

        Args:
            position_rad: Angle from the encoder's zero [rad].
            load: Fraction of the largest load, in [-1, 1].
            tick_ms: Not used: it has no register of time.
        """
        del tick_ms
        # Round the angle to the encoder's resolution, then to counts of the register.
        step_rad = 2.0 * math.pi / self._encoder_counts
        count = round(round(position_rad / step_rad) * step_rad / reg.RAD_PER_COUNT) - self.get(reg.HOMING_OFFSET)
        phase = self.get(reg.PHASE)
        wrapped = count if phase & reg.PHASE_FULL_ANGLE else count % reg.COUNTS_PER_REVOLUTION
        load = max(-1.0, min(1.0, load))
        self.put(reg.PRESENT_POSITION, wrapped)
        self.put(reg.PRESENT_SPEED, round(velocity_rad_s / reg.speed_unit_rad_s(phase)))
        self.put(reg.PRESENT_LOAD, round(load * reg.LOAD_FULL_SCALE))
        self.put(reg.PRESENT_CURRENT, round(load * STALL_CURRENT_A / reg.CURRENT_UNIT_A))
        self.put(reg.MOVING, abs(velocity_rad_s / reg.RAD_PER_COUNT) > _MOVING_COUNTS_PER_S)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return no error, and the bytes of the answer to a READ; beyond the table, zeros."""
        return 0, bytes(self._memory[address : address + length]).ljust(length, b"\0")

    def write(self, address: int, data: bytes) -> tuple[int, bool]:
        """Write registers; return no error, and whether `command` may have changed."""
        torque_was_on, moved = self.get(reg.TORQUE_ENABLE), False
        for register in reg.TABLE.registers.values():
            # Take the registers that lie wholly within the data.
            begin = register.address - address
            if not 0 <= begin <= len(data) - register.size:
                continue
            value = register.decode(data[begin : begin + register.size])
            if not register.writable or register in _FIXED or not register.minimum <= value <= register.maximum:
                continue
            # Without the lock, EEPROM registers also survive a restart.
            self.put(register, value)
            moved |= register in _MOTION
            if register.eeprom and not self.get(reg.LOCK):
                place = slice(register.address, register.end)
                self._saved = self._saved[: place.start] + register.encode(value) + self._saved[place.stop :]
            if register == reg.GOAL_POSITION and self._goal_wakes:
                self.put(reg.TORQUE_ENABLE, 1)
        return 0, moved and bool(torque_was_on or self.get(reg.TORQUE_ENABLE))

    def register_write(self, address: int, data: bytes) -> None:
        """Store a REG_WRITE until the next ACTION."""
        super().register_write(address, data)
        self.put(reg.ASYNC_WRITE, 1)

    def action(self) -> tuple[int, bool]:
        """Carry out the stored write, if there is one."""
        self.put(reg.ASYNC_WRITE, 0)
        return super().action()

    def reboot(self) -> None:
        """Restart as after a loss of power, torque off: EEPROM registers as saved, all others at their defaults."""
        self._memory[:] = self._saved
        super().reboot()
        self.put(reg.TORQUE_LIMIT, self.get(reg.MAX_TORQUE))

    def overload(self) -> None:
        """Report the alarms from now on; the motor is off as long as one of them is among the unloading conditions."""
        self.put(reg.STATUS, self._faults)
