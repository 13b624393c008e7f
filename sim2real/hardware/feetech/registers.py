"""The memory table of Feetech's STS servos with magnetic encoders, and the units of its registers.

Addresses, sizes, ranges and defaults are those of Feetech's "STS Series Servo Memory Table" (doc.feetech.cn), model
number and sign bits those of LeRobot's `motors/feetech/tables.py`. Comments name other sources, and assumptions.
Numbers are little endian. A signed one is a magnitude and a sign bit, not a two's complement.
"""

import math
from enum import IntEnum
from typing import Final

from sim2real.hardware.bus.registers import MemoryTable, Register, eeprom, ram

COUNTS_PER_REVOLUTION: Final = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_REVOLUTION
ACCELERATION_UNIT: Final = 100  # counts/s^2; 8.7 deg/s^2 in the table
DUTY_PER_RAD_AND_GAIN: Final = 0.166  # duty for a radian of error and a P gain of 1: measured by Rhoban (BAM, STS3215)
LOAD_FULL_SCALE: Final = 1000  # load and torque registers count in units of 0.1 %
CURRENT_UNIT_A: Final = 0.0065
FASTEST_COUNTS_PER_S: Final = 3400
"""Speed of the setpoint at power-up, measured by Rhoban (BAM): about the motor's speed without load."""
BAUD_RATES: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Bits per second, by the value of the register Baud Rate."""

# Bits of the register Phase.
PHASE_COUNTS_PER_S: Final = 0x04  # speeds are in counts/s; if not set, in units of 0.732 rpm, which are 50 counts/s
PHASE_ZERO_IS_FASTEST: Final = 0x08  # Goal Speed 0 means top speed; if not set, stop
PHASE_FULL_ANGLE: Final = 0x10  # positions count turns; if not set, they wrap from 4095 to 0


class Mode(IntEnum):
    """Values of the register Operating Mode."""

    POSITION = 0
    VELOCITY = 1
    PWM = 2
    STEP = 3


FIRMWARE_MAJOR = Register("firmware_major", 0, 1, default=3, eeprom=True)
FIRMWARE_MINOR = Register("firmware_minor", 1, 1, default=10, eeprom=True)
MODEL_NUMBER = Register("model_number", 3, 2, default=777, eeprom=True)
ID = eeprom("id", 5, 1, 0, 253, 1)
BAUD_RATE = eeprom("baud_rate", 6, 1, 0, 7, 0)
# Feetech's newer tables call it reserved, "not functional on STS"; LeRobot finds 250 (0.5 ms) there and writes 0.
RETURN_DELAY_TIME = eeprom("return_delay_time", 7, 1, 0, 254, 250)
RESPONSE_LEVEL = eeprom("response_level", 8, 1, 0, 1, 1)
MIN_POSITION = eeprom("min_position", 9, 2, 0, 4094, 0)
MAX_POSITION = eeprom("max_position", 11, 2, 0, 4095, 4095)
MAX_TEMPERATURE = eeprom("max_temperature", 13, 1, 0, 100, 70)
MAX_VOLTAGE = eeprom("max_voltage", 14, 1, 0, 254, 140)  # assumed: that of a servo for 12 V; in units of 0.1 V
MIN_VOLTAGE = eeprom("min_voltage", 15, 1, 0, 254, 40)
MAX_TORQUE = eeprom("max_torque", 16, 2, 0, 1000, 1000)
# Default assumed: the protocol manual's examples have speeds in counts/s; LeRobot leaves speeds alone, and servos move.
PHASE = eeprom("phase", 18, 1, 0, 254, PHASE_COUNTS_PER_S | PHASE_ZERO_IS_FASTEST)
UNLOADING = eeprom("unloading", 19, 1, 0, 254, 0b101111)  # alarms that switch the motor off; assumed: all
P_GAIN = eeprom("p_gain", 21, 1, 0, 254, 32)  # defaults of the gains: LeRobot, so101_follower.py
D_GAIN = eeprom("d_gain", 22, 1, 0, 254, 32)
I_GAIN = eeprom("i_gain", 23, 1, 0, 254, 0)
PROTECTION_CURRENT = eeprom("protection_current", 28, 2, 0, 2047, 511)
HOMING_OFFSET = eeprom("homing_offset", 31, 2, -2047, 2047, 0, sign=11)
OPERATING_MODE = eeprom("operating_mode", 33, 1, 0, 3, 0)
PROTECTIVE_TORQUE = eeprom("protective_torque", 34, 1, 0, 254, 20)
PROTECTION_TIME = eeprom("protection_time", 35, 1, 0, 254, 200)
OVERLOAD_TORQUE = eeprom("overload_torque", 36, 1, 0, 254, 80)
TORQUE_ENABLE = ram("torque_enable", 40, 1, 0, 1, 0)  # 2: damping, 128: this is the centre; neither is used here
ACCELERATION = ram("acceleration", 41, 1, 0, 254, 0)
GOAL_POSITION = ram("goal_position", 42, 2, -32767, 32767, 0, sign=15)
GOAL_TIME = ram("goal_time", 44, 2, -1000, 1000, 0, sign=10)  # in PWM mode the duty, in position mode unused
GOAL_SPEED = ram("goal_speed", 46, 2, -32767, 32767, FASTEST_COUNTS_PER_S, sign=15)
TORQUE_LIMIT = ram("torque_limit", 48, 2, 0, 1000, 1000)
LOCK = ram("lock", 55, 1, 0, 1, 1)
PRESENT_POSITION = Register("present_position", 56, 2, sign=15)
PRESENT_SPEED = Register("present_speed", 58, 2, sign=15)
PRESENT_LOAD = Register("present_load", 60, 2, sign=10)
PRESENT_VOLTAGE = Register("present_voltage", 62, 1, default=120)
PRESENT_TEMPERATURE = Register("present_temperature", 63, 1, default=30)
ASYNC_WRITE = Register("async_write", 64, 1)
STATUS = Register("status", 65, 1)
MOVING = Register("moving", 66, 1)
PRESENT_CURRENT = Register("present_current", 69, 2, sign=15)

TABLE: Final = MemoryTable(
    list(globals().values()),
    87,
    TORQUE_ENABLE,
    (GOAL_POSITION, GOAL_TIME, GOAL_SPEED),
    MODEL_NUMBER,
    ID,
    RETURN_DELAY_TIME,
    PRESENT_POSITION,
    (FIRMWARE_MAJOR, FIRMWARE_MINOR),
    PRESENT_VOLTAGE,
    PRESENT_TEMPERATURE,
)


def speed_unit_rad_s(phase: int) -> float:
    """Return the unit of the speed registers [rad/s], which bit 2 of the register Phase sets."""
    return RAD_PER_COUNT * (1 if phase & PHASE_COUNTS_PER_S else 50)


def full_torque_error_rad(p_gain: int) -> float:
    """Return the position error at which the controller gives full duty [rad]."""
    return 1.0 / (p_gain * DUTY_PER_RAD_AND_GAIN)
