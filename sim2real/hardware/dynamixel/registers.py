"""The control table of DYNAMIXEL X-series servos (Protocol 2.0), and the units of its registers.

Addresses, sizes, ranges and defaults are those of ROBOTIS' e-Manual for the XL430-W250. Other X servos have the same
addresses, and differ in limits, gains and in the meaning of address 126 (load or current).
"""

import math
from typing import Final

from sim2real.hardware.bus.registers import TWOS_COMPLEMENT, MemoryTable, Register, eeprom, ram

COUNTS_PER_REVOLUTION: Final = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_REVOLUTION
RAD_S_PER_COUNT: Final = 0.229 * 2.0 * math.pi / 60.0  # velocity registers count in units of 0.229 rpm
PWM_FULL_SCALE: Final = 885  # counts at 100 % of the supply voltage
P_GAIN_PER_PWM: Final = 256  # P gain that turns a count of error into a count of PWM: measured on XL330 (e-Manual: 128)
LOAD_FULL_SCALE: Final = 1000  # load registers count in units of 0.1 %
WATCHDOG_UNIT_S: Final = 0.020
WATCHDOG_MAX_COUNT: Final = 127
WATCHDOG_TRIPPED: Final = -1
DRIVE_REVERSED: Final = 1  # bit of Drive Mode; others: profiles by time instead of speed, goals that switch torque on

# Bits of Hardware Error Status; the servo switches its own torque off when one of them is set.
HARDWARE_ERRORS: Final[dict[int, str]] = {
    0: "input voltage",
    2: "overheating",
    3: "motor encoder",
    4: "electrical shock",
    5: "overload",
}


MODEL_NUMBER = Register("model_number", 0, 2, default=1060, eeprom=True)
FIRMWARE_VERSION = Register("firmware_version", 6, 1, default=47, eeprom=True)
ID = eeprom("id", 7, 1, 0, 252, 1)
BAUD_RATE = eeprom("baud_rate", 8, 1, 0, 7, 3)
RETURN_DELAY_TIME = eeprom("return_delay_time", 9, 1, 0, 254, 250)
DRIVE_MODE = eeprom("drive_mode", 10, 1, 0, 13, 0)
OPERATING_MODE = eeprom("operating_mode", 11, 1, 0, 16, 3)
HOMING_OFFSET = eeprom("homing_offset", 20, 4, -1_044_479, 1_044_479, 0, sign=TWOS_COMPLEMENT)
PWM_LIMIT = eeprom("pwm_limit", 36, 2, 0, PWM_FULL_SCALE, PWM_FULL_SCALE)
VELOCITY_LIMIT = eeprom("velocity_limit", 44, 4, 0, 1023, 265)
MAX_POSITION_LIMIT = eeprom("max_position_limit", 48, 4, 0, 4095, 4095)
MIN_POSITION_LIMIT = eeprom("min_position_limit", 52, 4, 0, 4095, 0)
TORQUE_ENABLE = ram("torque_enable", 64, 1, 0, 1)
LED = ram("led", 65, 1, 0, 1)
STATUS_RETURN_LEVEL = ram("status_return_level", 68, 1, 0, 2, 2)
HARDWARE_ERROR_STATUS = Register("hardware_error_status", 70, 1)
POSITION_D_GAIN = ram("position_d_gain", 80, 2, 0, 16383, 4000)
POSITION_I_GAIN = ram("position_i_gain", 82, 2, 0, 16383, 0)
POSITION_P_GAIN = ram("position_p_gain", 84, 2, 0, 16383, 640)
BUS_WATCHDOG = ram("bus_watchdog", 98, 1, 0, WATCHDOG_MAX_COUNT, 0, sign=TWOS_COMPLEMENT)
GOAL_PWM = ram("goal_pwm", 100, 2, -PWM_FULL_SCALE, PWM_FULL_SCALE, 0, sign=TWOS_COMPLEMENT)
GOAL_VELOCITY = ram("goal_velocity", 104, 4, -1023, 1023, 0, sign=TWOS_COMPLEMENT)
PROFILE_ACCELERATION = ram("profile_acceleration", 108, 4, 0, 32767)
PROFILE_VELOCITY = ram("profile_velocity", 112, 4, 0, 32767)
GOAL_POSITION = ram("goal_position", 116, 4, -1_048_575, 1_048_575, 0, sign=TWOS_COMPLEMENT)
REALTIME_TICK = Register("realtime_tick", 120, 2)
MOVING = Register("moving", 122, 1)
PRESENT_PWM = Register("present_pwm", 124, 2, sign=TWOS_COMPLEMENT)
PRESENT_LOAD = Register("present_load", 126, 2, sign=TWOS_COMPLEMENT)
PRESENT_VELOCITY = Register("present_velocity", 128, 4, sign=TWOS_COMPLEMENT)
PRESENT_POSITION = Register("present_position", 132, 4, sign=TWOS_COMPLEMENT)
PRESENT_INPUT_VOLTAGE = Register("present_input_voltage", 144, 2, default=120)
PRESENT_TEMPERATURE = Register("present_temperature", 146, 1, default=30)

TABLE: Final = MemoryTable(
    list(globals().values()),
    PRESENT_TEMPERATURE.end,
    TORQUE_ENABLE,
    (GOAL_PWM, GOAL_VELOCITY, GOAL_POSITION),
    MODEL_NUMBER,
    ID,
    RETURN_DELAY_TIME,
    PRESENT_POSITION,
    (FIRMWARE_VERSION,),
    PRESENT_INPUT_VOLTAGE,
    PRESENT_TEMPERATURE,
)


def full_torque_error_rad(p_gain: int) -> float:
    """Return the position error at which the controller gives full PWM [rad]."""
    return PWM_FULL_SCALE * P_GAIN_PER_PWM / p_gain * RAD_PER_COUNT


def rad_from_count(count: int) -> float:
    """Return the angle [rad] of a position count."""
    return count * RAD_PER_COUNT


def count_from_rad(angle_rad: float) -> int:
    """Return the position count nearest to an angle [rad]."""
    return round(angle_rad / RAD_PER_COUNT)


def rad_s_from_count(count: int) -> float:
    """Return the speed [rad/s] of a velocity count (0.229 rpm)."""
    return count * RAD_S_PER_COUNT


def count_from_rad_s(speed_rad_s: float) -> int:
    """Return the velocity count nearest to a speed [rad/s]."""
    return round(speed_rad_s / RAD_S_PER_COUNT)


def fraction_from_pwm(count: int) -> float:
    """Return the fraction of the supply voltage, in [-1, 1], of a PWM count."""
    return count / PWM_FULL_SCALE


def pwm_from_fraction(fraction: float) -> int:
    """Return the PWM count nearest to a fraction of the supply voltage in [-1, 1]."""
    return round(fraction * PWM_FULL_SCALE)


def describe_hardware_errors(bits: int) -> str:
    """Return the names of the bits that are set in Hardware Error Status, or "none"."""
    return ", ".join(name for bit, name in HARDWARE_ERRORS.items() if bits >> bit & 1) or "none"
