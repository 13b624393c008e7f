"""DYNAMIXEL X servos (Protocol 2.0): packets, the memory table, and what their firmware does differently.

    FF FF FD 00 | id | length (2) | instruction | parameters (an error byte first in a status packet) | CRC-16 (2)

Addresses, sizes, ranges and defaults are those of ROBOTIS' e-Manual for the XL430-W250. Other X servos have the same
addresses, and differ in limits, gains and in the meaning of address 126 (load or current). The tests compare the
packets with ROBOTIS' own SDK.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final

from sim2real.errors import SafetyStop, Sim2RealError
from sim2real.hardware.bus.packets import Answer, Instruction, Packet, PacketFormat
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.registers import TWOS_COMPLEMENT, Family, Register, ServoModel, eeprom, ram
from sim2real.hardware.bus.servos import ServoJoint, Servos
from sim2real.hardware.device import POSITION, VOLTAGE, OperatingMode

HEADER: Final = b"\xff\xff\xfd\x00"
MAX_PACKET_LENGTH: Final = 1024
ALERT_BIT: Final = 0x80  # set in a status packet's error byte while Hardware Error Status is not 0

_STUFFED: Final = (b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


class StatusError(IntEnum):
    """Error number of a status packet, without the alert bit."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE: Final = _crc_table()


def crc16(data: bytes | bytearray) -> int:
    """Return the CRC-16 of bytes (polynomial 0x8005, initial value 0, most significant bit first)."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) & 0xFF00) ^ _CRC_TABLE[(crc >> 8) ^ byte]
    return crc


class Protocol2(PacketFormat):
    """DYNAMIXEL Protocol 2.0."""

    header = HEADER
    prefix_bytes = 7  # header, id, length
    answer_bytes = 11
    address_bytes = 2
    refusals = 0xFF & ~ALERT_BIT
    off_errors = (0, ALERT_BIT)
    ping_bytes = 3  # model number and firmware version

    def frame(self, servo_id: int, body: bytes) -> bytes:
        # A header inside the body would look like the start of a packet, so a byte is inserted after it (stuffing).
        body = body.replace(*_STUFFED)
        packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc16(packet).to_bytes(2, "little")

    def build_status(self, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
        return self.build(servo_id, Instruction.STATUS, bytes((error,)) + parameters)

    def following(self, prefix: bytearray) -> int | None:
        length = int.from_bytes(prefix[5:7], "little")
        return length if 3 <= length <= MAX_PACKET_LENGTH else None

    def parse(self, packet: bytes) -> Packet:
        intact = crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")
        body = packet[self.prefix_bytes : -2].replace(_STUFFED[1], _STUFFED[0])
        return Packet(packet[4], body[0], body[1:], intact)

    def answer(self, packet: Packet) -> Answer | None:
        if packet.code != Instruction.STATUS or not packet.parameters:
            return None
        return Answer(packet.servo_id, packet.parameters[0], packet.parameters[1:])


PROTOCOL: Final = Protocol2()

_REASONS: Final[dict[int, str]] = {
    StatusError.RESULT_FAIL: "it failed to carry it out",
    StatusError.INSTRUCTION: "the instruction is unknown to it",
    StatusError.CRC: "the instruction arrived with a wrong checksum",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the data are shorter than the register",
    StatusError.DATA_LIMIT: "the value is beyond a limit set in the servo",
    StatusError.ACCESS: "the register cannot be written or read now (EEPROM registers: not while torque is on)",
}

COUNTS_PER_REVOLUTION: Final = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_REVOLUTION
RAD_S_PER_COUNT: Final = 0.229 * 2.0 * math.pi / 60.0  # velocity registers count in units of 0.229 rpm
PWM_FULL_SCALE: Final = 885  # counts at 100 % of the supply voltage
# P gain with which one count of error gives one count of PWM: measured on XL330 (e-Manual: 128).
P_GAIN_PER_PWM: Final = 256
LOAD_FULL_SCALE: Final = 1000  # load registers have units of 0.1 %
# Bit of Drive Mode; other bits: profiles by time instead of speed, goals that switch torque on.
DRIVE_REVERSED: Final = 1

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
BUS_WATCHDOG = ram("bus_watchdog", 98, 1, 0, 127, 0, sign=TWOS_COMPLEMENT, unit=0.020)
GOAL_PWM = ram("goal_pwm", 100, 2, -PWM_FULL_SCALE, PWM_FULL_SCALE, 0, sign=TWOS_COMPLEMENT, unit=1 / PWM_FULL_SCALE)
GOAL_VELOCITY = ram("goal_velocity", 104, 4, -1023, 1023, 0, sign=TWOS_COMPLEMENT, unit=RAD_S_PER_COUNT)
PROFILE_ACCELERATION = ram("profile_acceleration", 108, 4, 0, 32767)
PROFILE_VELOCITY = ram("profile_velocity", 112, 4, 0, 32767, unit=RAD_S_PER_COUNT)
GOAL_POSITION = ram("goal_position", 116, 4, -1_048_575, 1_048_575, 0, sign=TWOS_COMPLEMENT, unit=RAD_PER_COUNT)
REALTIME_TICK = Register("realtime_tick", 120, 2)
MOVING = Register("moving", 122, 1)
PRESENT_PWM = Register("present_pwm", 124, 2, sign=TWOS_COMPLEMENT, unit=1 / PWM_FULL_SCALE)
PRESENT_LOAD = Register("present_load", 126, 2, sign=TWOS_COMPLEMENT, unit=1 / LOAD_FULL_SCALE)
PRESENT_VELOCITY = Register("present_velocity", 128, 4, sign=TWOS_COMPLEMENT, unit=RAD_S_PER_COUNT)
PRESENT_POSITION = Register("present_position", 132, 4, sign=TWOS_COMPLEMENT, unit=RAD_PER_COUNT)
PRESENT_INPUT_VOLTAGE = Register("present_input_voltage", 144, 2, default=120)
PRESENT_TEMPERATURE = Register("present_temperature", 146, 1, default=30)

_MANUAL: Final = "e-Manual, Bus Watchdog(98); not measured by us"
_FORUM: Final = "ROBOTIS reproduced it with all 330s: forum.robotis.com/t/4814 (firmware 51)"
MODELS: Final = {
    1020: ServoModel("XM430-W350", True, _MANUAL),
    1030: ServoModel("XM430-W210", True, _MANUAL),
    1060: ServoModel("XL430-W250", True, _MANUAL),
    1190: ServoModel("XL330-M077", False, _FORUM),
    1200: ServoModel("XL330-M288", False, _FORUM),
    1210: ServoModel("XC330-T181", False, _FORUM),
    1220: ServoModel("XC330-T288", False, _FORUM),
    1230: ServoModel("XC330-M181", False, _FORUM),
    1240: ServoModel("XC330-M288", False, _FORUM),
}
"""Model number -> model."""

FAMILY: Final = Family(
    "DYNAMIXEL",
    PROTOCOL,
    list(globals().values()),
    PRESENT_TEMPERATURE.end,
    baud_rates=(9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000),
    torque=TORQUE_ENABLE,
    modes={
        VOLTAGE: (OperatingMode.PWM, GOAL_PWM),
        POSITION: (OperatingMode.POSITION, GOAL_POSITION),
    },
    goals=(GOAL_PWM, GOAL_VELOCITY, GOAL_POSITION),
    limits=(MIN_POSITION_LIMIT, MAX_POSITION_LIMIT),
    mode=OPERATING_MODE,
    model_number=MODEL_NUMBER,
    servo_id=ID,
    return_delay=RETURN_DELAY_TIME,
    position=PRESENT_POSITION,
    velocity=PRESENT_VELOCITY,
    load=PRESENT_LOAD,
    controller=(POSITION_P_GAIN, POSITION_D_GAIN, PROFILE_VELOCITY),
    firmware=(FIRMWARE_VERSION,),
    voltage=PRESENT_INPUT_VOLTAGE,
    temperature=PRESENT_TEMPERATURE,
    begin={STATUS_RETURN_LEVEL: 2, RETURN_DELAY_TIME: 0},
    fixed={POSITION_I_GAIN: 0, PROFILE_ACCELERATION: 0},
    watched=((BUS_WATCHDOG,), (TORQUE_ENABLE,)),
    full_rad=PWM_FULL_SCALE * P_GAIN_PER_PWM * RAD_PER_COUNT,
    models=MODELS,
    watchdog=BUS_WATCHDOG,
)


def model(number: int) -> ServoModel:
    """Return the model of a number; an unknown one counts as a model that continues without its host."""
    return MODELS.get(number, ServoModel(f"model {number}", False, "unknown model: the worst is assumed"))


class DynamixelServos(Servos):
    """DYNAMIXEL X servos on one port; see `Servos`.

    Their bus watchdogs are set to `silence_s`, in multiples of 20 ms; what a servo does when its watchdog trips depends
    on the model.
    """

    family = FAMILY

    def model(self, servo_id: int, number: int) -> ServoModel:
        """Return the model of a number; an unknown one counts as a model that continues without its host."""
        del servo_id
        return model(number)

    def prepare(self, joint: ServoJoint) -> None:
        """Set profiles by speed, and goals that do not switch torque on."""
        self.link.set(joint.servo_id, DRIVE_MODE, self.link.read(joint.servo_id, DRIVE_MODE) & DRIVE_REVERSED)

    def failure(self, answer: Answer, what: str) -> Exception:
        """Return SafetyStop for the alert bit or a tripped watchdog, else the reason why the servo refused ``what``."""
        servo_id, error = answer.servo_id, answer.error
        if error & ALERT_BIT:
            bits = self.link.read(servo_id, HARDWARE_ERROR_STATUS, despite_error=True)
            names = ", ".join(name for bit, name in HARDWARE_ERRORS.items() if bits >> bit & 1) or "none"
            return SafetyStop(
                f"servo {servo_id} has stopped itself: {names}", hint="remove the cause, then reboot the servo"
            )
        if self.link.read(servo_id, BUS_WATCHDOG, despite_error=True) < 0:
            return self.tripped(servo_id)
        return Sim2RealError(f"servo {servo_id} refused {what}: {_REASONS.get(error, f'error {error}')}")


def servos(port: str, ids: Sequence[int], drive: Any, *, baud_rate: int, silence_s: float) -> DynamixelServos:
    """Return servos on a port, not opened yet: the device of the name ``dynamixel``; see ``load_device``."""
    return DynamixelServos(BusConfig.patient(port, baud_rate, silence_s), ids, drive)
