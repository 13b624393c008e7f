"""Feetech's STS servos with magnetic encoders: packets, the memory table, and what their firmware does differently.

    FF FF | id | length | instruction (status packet: error byte) | parameters | checksum

The length counts the bytes after it; the checksum is the inverted low byte of the sum of all bytes from the id on.
There is no stuffing: a header may occur inside a packet. Numbers are little endian; a signed one is a magnitude and a
sign bit, not a two's complement.

Sources: Feetech, "Servo SCS Communication Protocol" (its examples are in the tests) and "STS Series Servo Memory
Table" (doc.feetech.cn): addresses, sizes, ranges and defaults; scservo_sdk of PyPI's feetech-servo-sdk 1.0.0: the
error byte's bits; LeRobot's `motors/feetech/tables.py`: model numbers and sign bits. Comments name other sources, and
assumptions.
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Final

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import BROADCAST_ID, Answer, Packet, PacketFormat
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.registers import Family, Register, ServoModel, eeprom, ram
from sim2real.hardware.bus.servos import PositionDrive, ServoJoint, Servos
from sim2real.hardware.device import POSITION

HEADER: Final = b"\xff\xff"

ALARMS: Final[dict[int, str]] = {0: "input voltage", 1: "encoder", 2: "overheating", 3: "overcurrent", 5: "overload"}
"""Name of each bit of the error byte, which every status packet has, and of the register Status."""


def checksum(body: bytes | bytearray) -> int:
    """Return the checksum of a packet's bytes from id to last parameter."""
    return ~sum(body) & 0xFF


def describe_alarms(bits: int) -> str:
    """Return the names of the alarms in an error byte, or "none"."""
    return ", ".join(ALARMS.get(bit, f"bit {bit}") for bit in range(8) if bits >> bit & 1) or "none"


class StsProtocol(PacketFormat):
    """The protocol of Feetech's SMS and STS servos."""

    header = HEADER
    prefix_bytes = 4  # header, id, length
    answer_bytes = 6
    address_bytes = 1
    off_errors = tuple(sum(1 << bit for bit in on) for n in range(len(ALARMS) + 1) for on in combinations(ALARMS, n))

    def frame(self, servo_id: int, body: bytes) -> bytes:
        summed = bytes((servo_id, len(body) + 1)) + body
        return HEADER + summed + bytes((checksum(summed),))

    def following(self, prefix: bytearray) -> int | None:
        return prefix[3] if prefix[2] <= BROADCAST_ID and prefix[3] >= 2 else None

    def parse(self, packet: bytes) -> Packet:
        return Packet(packet[2], packet[4], packet[5:-1], checksum(packet[2:-1]) == packet[-1])

    def answer(self, packet: Packet) -> Answer:
        return Answer(packet.servo_id, packet.code, packet.parameters)


PROTOCOL: Final = StsProtocol()


COUNTS_PER_REVOLUTION: Final = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_REVOLUTION
DUTY_PER_RAD_AND_GAIN: Final = 0.166  # duty for a radian of error and a P gain of 1: measured by Rhoban (BAM, STS3215)
LOAD_FULL_SCALE: Final = 1000  # load and torque registers count in units of 0.1 %
FASTEST_COUNTS_PER_S: Final = 3400
"""Speed of the setpoint after power-up, measured by Rhoban (BAM): about the motor's speed without load."""
BAUD_RATES: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Bits per second, by the value of the register Baud Rate."""

# Bits of the register Phase.
PHASE_COUNTS_PER_S: Final = 0x04  # speeds are in counts/s; if not set, in units of 0.732 rpm, which are 50 counts/s
PHASE_ZERO_IS_FASTEST: Final = 0x08  # Goal Speed 0 means top speed; if not set, stop
PHASE_FULL_ANGLE: Final = 0x10  # positions count turns; if not set, they wrap from 4095 to 0


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
MAX_VOLTAGE = eeprom("max_voltage", 14, 1, 0, 254, 140)  # assumed: the value of a servo for 12 V; in units of 0.1 V
MIN_VOLTAGE = eeprom("min_voltage", 15, 1, 0, 254, 40)
MAX_TORQUE = eeprom("max_torque", 16, 2, 0, 1000, 1000)
# Assumed default: the protocol manual's examples have speeds in counts/s; LeRobot sets no speeds, and servos move.
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
ACCELERATION = ram("acceleration", 41, 1, 0, 254, 0)  # 0: no limit
GOAL_POSITION = ram("goal_position", 42, 2, -32767, 32767, 0, sign=15, unit=RAD_PER_COUNT)
GOAL_TIME = ram("goal_time", 44, 2, -1000, 1000, 0, sign=10)  # the duty in PWM mode; unused in position mode
GOAL_SPEED = ram("goal_speed", 46, 2, -32767, 32767, FASTEST_COUNTS_PER_S, sign=15)
TORQUE_LIMIT = ram("torque_limit", 48, 2, 0, 1000, 1000, unit=1 / LOAD_FULL_SCALE)
LOCK = ram("lock", 55, 1, 0, 1, 1)
PRESENT_POSITION = Register("present_position", 56, 2, sign=15, unit=RAD_PER_COUNT)
PRESENT_SPEED = Register("present_speed", 58, 2, sign=15, unit=RAD_PER_COUNT)
PRESENT_LOAD = Register("present_load", 60, 2, sign=10, unit=1 / LOAD_FULL_SCALE)
PRESENT_VOLTAGE = Register("present_voltage", 62, 1, default=120)
PRESENT_TEMPERATURE = Register("present_temperature", 63, 1, default=30)
STATUS = Register("status", 65, 1)

_SOURCE: Final = "Feetech, STS Series Servo Memory Table: no register for it; not measured by us"
MODELS: Final = {777: ServoModel("STS3215", None, _SOURCE), 2825: ServoModel("STS3250", None, _SOURCE)}
"""Model number (LeRobot's tables.py) -> model."""

FAMILY: Final = Family(
    "Feetech",
    PROTOCOL,
    list(globals().values()),
    87,
    BAUD_RATES,
    torque=TORQUE_ENABLE,
    modes={POSITION: (0, GOAL_POSITION)},
    goals=(GOAL_POSITION, GOAL_TIME, GOAL_SPEED),
    limits=(MIN_POSITION, MAX_POSITION),
    mode=OPERATING_MODE,
    model_number=MODEL_NUMBER,
    servo_id=ID,
    return_delay=RETURN_DELAY_TIME,
    position=PRESENT_POSITION,
    velocity=PRESENT_SPEED,
    load=PRESENT_LOAD,
    controller=(P_GAIN, D_GAIN, GOAL_SPEED),
    firmware=(FIRMWARE_MAJOR, FIRMWARE_MINOR),
    voltage=PRESENT_VOLTAGE,
    temperature=PRESENT_TEMPERATURE,
    begin={RESPONSE_LEVEL: 1, LOCK: 1, RETURN_DELAY_TIME: 0},
    fixed={I_GAIN: 0, ACCELERATION: 0, TORQUE_LIMIT: LOAD_FULL_SCALE},
    watched=((TORQUE_ENABLE, ACCELERATION, GOAL_SPEED, TORQUE_LIMIT),),
    full_rad=1.0 / DUTY_PER_RAD_AND_GAIN,
    models=MODELS,
)


def speed_unit_rad_s(phase: int) -> float:
    """Return the unit of the speed registers [rad/s], which bit 2 of the register Phase sets."""
    return RAD_PER_COUNT * (1 if phase & PHASE_COUNTS_PER_S else 50)


LEROBOT: Final = PositionDrive(p_gain=16, d_gain=32)
"""LeRobot's gains."""


class StsServos(Servos):
    """Feetech STS servos on one port; see `Servos`.

    They have no watchdog: if this process dies, they go on to the last goal until the guardian takes their torque off.
    """

    family = FAMILY

    def __init__(self, config: BusConfig, joints: Sequence[ServoJoint | int], drive: PositionDrive = LEROBOT) -> None:
        self._phases: dict[int, int] = {}
        super().__init__(config, joints, drive)

    def failure(self, answer: Answer, what: str) -> Exception:
        """Return SafetyStop: the bits of the error byte are alarms."""
        del what
        return SafetyStop(
            f"servo {answer.servo_id} reports an alarm: {describe_alarms(answer.error)}",
            hint="remove the cause, then switch its power off and on; does the supply's voltage fit the servo?",
        )

    def prepare(self, joint: ServoJoint) -> None:
        """Compare the homing offset with the calibration, and read the phase, which sets the unit of speeds."""
        servo_id, link = joint.servo_id, self.link
        offset = link.read(servo_id, HOMING_OFFSET)
        if joint.homing_offset not in (None, offset):
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) has homing offset {offset}, its calibration has "
                f"{joint.homing_offset}",
                hint="this is another arm's calibration, or the servo was changed: run lerobot-calibrate",
            )
        self._phases[servo_id] = link.read(servo_id, PHASE)

    def speed_unit(self, servo_id: int) -> float:
        return speed_unit_rad_s(self._phases.get(servo_id, PHASE.default))

    def speed_count(self, servo_id: int, speed_rad_s: float) -> int:
        """Return the count for the speed of a servo's setpoint; 0 means "stop" on some servos, top speed on others."""
        fastest = 0 if self._phases.get(servo_id, PHASE.default) & PHASE_ZERO_IS_FASTEST else FASTEST_COUNTS_PER_S
        count = speed_rad_s / self.speed_unit(servo_id)
        return fastest if count > GOAL_SPEED.maximum else max(1, round(count))


def servos(port: str, ids: Sequence[int], drive: PositionDrive, *, baud_rate: int, silence_s: float) -> StsServos:
    """Return servos on a port, not opened yet: the device of the name ``feetech``; see ``load_device``."""
    return StsServos(BusConfig.patient(port, baud_rate, silence_s), ids, drive)
