"""The memory table of Feetech's STS servos with magnetic encoders, and the units of its registers.

Addresses, sizes, ranges and defaults are those of Feetech's "STS Series Servo Memory Table" (doc.feetech.cn), model
number and sign bits those of LeRobot's `motors/feetech/tables.py`. What is from elsewhere, or assumed, says so.
Numbers are little endian. A signed one is a magnitude and a sign bit, not a two's complement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

COUNTS_PER_REVOLUTION: Final = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_REVOLUTION
ACCELERATION_UNIT: Final = 100  # counts/s^2; 8.7 deg/s^2 in the table
LOAD_FULL_SCALE: Final = 1000  # load and torque registers count in units of 0.1 %
CURRENT_UNIT_A: Final = 0.0065
P_GAIN_UNIT_PER_RAD: Final = 0.166
"""Duty per radian of position error and count of P gain: measured by Rhoban with an oscilloscope (BAM, STS3215)."""
FASTEST_COUNTS_PER_S: Final = 3400
"""Speed of the setpoint at power-up, as Rhoban found it (BAM): about what the motor reaches without load."""
RETURN_DELAY_UNIT_S: Final = 2e-6
BAUD_RATES: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Bits per second, by the value of the register Baud Rate."""

# Bits of the register Phase.
PHASE_COUNTS_PER_S: Final = 0x04  # speeds are in counts/s; if not set, in units of 0.732 rpm, which are 50 counts/s
PHASE_ZERO_IS_FASTEST: Final = 0x08  # Goal Speed 0 means as fast as it can; if not set, stop
PHASE_FULL_ANGLE: Final = 0x10  # positions count turns; if not set, they wrap from 4095 to 0


class Mode(IntEnum):
    """Values of the register Operating Mode."""

    POSITION = 0
    VELOCITY = 1
    PWM = 2
    STEP = 3


@dataclass(frozen=True)
class StsRegister:
    """One entry of the memory table.

    Args:
        name: Its name.
        address: Address of the first byte.
        size: Number of bytes: 1 or 2.
        minimum: Smallest value that may be written [counts].
        maximum: Largest value that may be written [counts].
        default: Value after power-up [counts].
        sign_bit: Bit that means "negative"; None: the value is never negative.
        writable: Whether it can be written.
        eeprom: Whether a value that is written while Lock is 0 outlives a loss of power.
    """

    name: str
    address: int
    size: int
    minimum: int = 0
    maximum: int = 0
    default: int = 0
    sign_bit: int | None = None
    writable: bool = False
    eeprom: bool = False

    @property
    def end(self) -> int:
        """The address after the register's last byte."""
        return self.address + self.size

    def decode(self, data: bytes | bytearray) -> int:
        """Return the value of `size` bytes [counts]."""
        value = int.from_bytes(data, "little")
        if self.sign_bit is None or not value >> self.sign_bit & 1:
            return value
        return -(value & ~(1 << self.sign_bit))

    def encode(self, value: int) -> bytes:
        """Return the bytes of a value [counts]; one that is too large for the register is cut to what fits."""
        bits = 8 * self.size if self.sign_bit is None else self.sign_bit
        magnitude = min(abs(value), (1 << bits) - 1)
        sign = 1 << self.sign_bit if self.sign_bit is not None and value < 0 else 0
        return (magnitude | sign).to_bytes(self.size, "little")


def _eeprom(
    name: str, address: int, size: int, low: int, high: int, default: int, sign: int | None = None
) -> StsRegister:
    return StsRegister(name, address, size, low, high, default, sign, writable=True, eeprom=True)


def _ram(name: str, address: int, size: int, low: int, high: int, default: int, sign: int | None = None) -> StsRegister:
    return StsRegister(name, address, size, low, high, default, sign, writable=True)


MODEL_NUMBER = StsRegister("model_number", 3, 2, default=777, eeprom=True)
ID = _eeprom("id", 5, 1, 0, 253, 1)
BAUD_RATE = _eeprom("baud_rate", 6, 1, 0, 7, 0)
# Feetech's newer tables call it reserved, "not functional on STS"; LeRobot finds 250 (0.5 ms) there and writes 0.
RETURN_DELAY_TIME = _eeprom("return_delay_time", 7, 1, 0, 254, 250)
RESPONSE_LEVEL = _eeprom("response_level", 8, 1, 0, 1, 1)
MIN_POSITION = _eeprom("min_position", 9, 2, 0, 4094, 0)
MAX_POSITION = _eeprom("max_position", 11, 2, 0, 4095, 4095)
MAX_TEMPERATURE = _eeprom("max_temperature", 13, 1, 0, 100, 70)
MAX_VOLTAGE = _eeprom("max_voltage", 14, 1, 0, 254, 140)  # assumed: that of a servo for 12 V; in units of 0.1 V
MIN_VOLTAGE = _eeprom("min_voltage", 15, 1, 0, 254, 40)
MAX_TORQUE = _eeprom("max_torque", 16, 2, 0, 1000, 1000)
# Default assumed: the protocol manual's examples have speeds in counts/s; LeRobot leaves speeds alone, and servos move.
PHASE = _eeprom("phase", 18, 1, 0, 254, PHASE_COUNTS_PER_S | PHASE_ZERO_IS_FASTEST)
UNLOADING = _eeprom("unloading", 19, 1, 0, 254, 0b101111)  # alarms that switch the motor off; assumed: all
P_GAIN = _eeprom("p_gain", 21, 1, 0, 254, 32)  # defaults of the gains: LeRobot, so101_follower.py
D_GAIN = _eeprom("d_gain", 22, 1, 0, 254, 32)
I_GAIN = _eeprom("i_gain", 23, 1, 0, 254, 0)
PROTECTION_CURRENT = _eeprom("protection_current", 28, 2, 0, 2047, 511)
HOMING_OFFSET = _eeprom("homing_offset", 31, 2, -2047, 2047, 0, sign=11)
OPERATING_MODE = _eeprom("operating_mode", 33, 1, 0, 3, 0)
PROTECTIVE_TORQUE = _eeprom("protective_torque", 34, 1, 0, 254, 20)
PROTECTION_TIME = _eeprom("protection_time", 35, 1, 0, 254, 200)
OVERLOAD_TORQUE = _eeprom("overload_torque", 36, 1, 0, 254, 80)
TORQUE_ENABLE = _ram("torque_enable", 40, 1, 0, 1, 0)  # 2: damping, 128: this is the centre; neither is used here
ACCELERATION = _ram("acceleration", 41, 1, 0, 254, 0)
GOAL_POSITION = _ram("goal_position", 42, 2, -32767, 32767, 0, sign=15)
GOAL_TIME = _ram("goal_time", 44, 2, -1000, 1000, 0, sign=10)  # in PWM mode the duty, in position mode unused
GOAL_SPEED = _ram("goal_speed", 46, 2, -32767, 32767, FASTEST_COUNTS_PER_S, sign=15)
TORQUE_LIMIT = _ram("torque_limit", 48, 2, 0, 1000, 1000)
LOCK = _ram("lock", 55, 1, 0, 1, 1)
PRESENT_POSITION = StsRegister("present_position", 56, 2, sign_bit=15)
PRESENT_SPEED = StsRegister("present_speed", 58, 2, sign_bit=15)
PRESENT_LOAD = StsRegister("present_load", 60, 2, sign_bit=10)
PRESENT_VOLTAGE = StsRegister("present_voltage", 62, 1, default=120)
PRESENT_TEMPERATURE = StsRegister("present_temperature", 63, 1, default=30)
ASYNC_WRITE = StsRegister("async_write", 64, 1)
STATUS = StsRegister("status", 65, 1)
MOVING = StsRegister("moving", 66, 1)
PRESENT_CURRENT = StsRegister("present_current", 69, 2, sign_bit=15)

TABLE: Final[dict[int, StsRegister]] = {r.address: r for r in list(globals().values()) if isinstance(r, StsRegister)}
TABLE_BYTES: Final = 87
GOALS: Final = (GOAL_POSITION, GOAL_TIME, GOAL_SPEED)


def speed_unit_rad_s(phase: int) -> float:
    """Return the unit of the speed registers [rad/s], which bit 2 of the register Phase sets."""
    return RAD_PER_COUNT * (1 if phase & PHASE_COUNTS_PER_S else 50)
