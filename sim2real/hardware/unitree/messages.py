"""The messages of a Go2's low-level interface, `LowCmd` and `LowState`, as numpy records.

A message is a record in the layout of Unitree's C struct, `message.record`. Its fields have Unitree's names:

    command = LowCmd()
    command.record["motor_cmd"]["q"][:12] = 0.0
    command.sign()
"""

import zlib
from dataclasses import dataclass
from inspect import get_annotations
from typing import Any, ClassVar, Final, Self, get_args

import numpy as np

from sim2real.errors import UsageError
from sim2real.installation import with_extra

try:
    from cyclonedds import idl
    from cyclonedds.idl import annotations
    from cyclonedds.idl.types import array, float32, int16, int32, uint8, uint16, uint32
except ImportError as error:
    raise UsageError("Unitree's robots need cyclonedds, which is not installed", hint=with_extra("unitree")) from error

COMMAND_TOPIC: Final = "rt/lowcmd"
STATE_TOPIC: Final = "rt/lowstate"
MOTORS: Final = 12
"""Motors of a Go2; the messages have 20 places."""
HEAD: Final = (0xFE, 0xEF)
"""The first two bytes of a command."""
LOW_LEVEL: Final = 0xFF
"""`level_flag` of a command to the motors themselves."""
OFF, SERVO = 0x00, 0x01
"""Modes of a motor: off, or it follows `q`, `dq`, `kp`, `kd` and `tau`."""
NO_POSITION: Final = 2.146e9
"""`q` of a motor without a position controller (Unitree's PosStopF)."""
NO_VELOCITY: Final = 16000.0
"""`dq` of a motor without a velocity controller (Unitree's VelStopF)."""

_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"  # XCDR1
_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32(record: np.ndarray) -> int:
    """Return the CRC of a record: over its words but the last, polynomial 0x04c11db7, most significant bit first.

    zlib computes the same polynomial from the least significant bit on, so bytes and result are reversed: 2 us for a
    command and 3 us for a state, against 360 us bit by bit in Python.
    """
    big_endian = np.frombuffer(record.tobytes(), "<u4")[:-1].byteswap().tobytes()
    reflected = zlib.crc32(big_endian.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


class _Record:
    """A message that is a record in memory, in place of one Python object for each field.

    On the wire (XCDR1) the bytes are those of the C struct, except that the first motor's `mode` follows the byte
    before it without padding: `_cut` is the place of that mode on the wire. `_content` is 0 at the bytes of padding.
    """

    layout: ClassVar[np.dtype]
    _cut: ClassVar[int]
    _content: ClassVar[np.ndarray]

    def __init__(self, record: np.ndarray | None = None) -> None:
        self.record = np.zeros((), self.layout) if record is None else record

    def sign(self) -> None:
        """Set the CRC."""
        self.record["crc"] = crc32(self.record)

    @property
    def intact(self) -> bool:
        """Whether the CRC is that of the content."""
        return int(self.record["crc"]) == crc32(self.record)

    def to_wire(self) -> bytes:
        """Return the message on the wire."""
        raw, cut = self.record.tobytes(), self._cut
        mode, padding = _aligned(cut), bytes(_aligned(cut + 1) - cut - 1)
        return b"".join((_LITTLE_ENDIAN, raw[:cut], raw[mode : mode + 1], padding, raw[mode + 4 :]))

    @classmethod
    def from_wire(cls, data: bytes) -> Self:
        """Return the message of these bytes; ValueError if they are not one in XCDR1."""
        wire, cut = bytes(data), cls._cut + 4
        mode, size = _aligned(cls._cut), cls.layout.itemsize
        if wire[:2] != _LITTLE_ENDIAN[:2] or len(wire) != size:
            raise ValueError(f"{len(wire)} bytes that begin with {wire[:2].hex()} are no {cls.__name__} in XCDR1")
        raw = b"".join((wire[4:cut], bytes(mode - cls._cut), wire[cut : cut + 1], bytes(3), wire[_aligned(cut + 1) :]))
        # The CRC covers padding as zeros, also where the sender has other values.
        return cls((np.frombuffer(raw, np.uint8) & cls._content).view(cls.layout).reshape(()))


def _aligned(offset: int) -> int:
    return (offset + 3) & ~3


def _layout(declared: object) -> np.dtype:
    """Return the layout in C of a type of the messages."""
    if isinstance(declared, type):  # of the class alone: not the fields of `_Record`
        fields = get_annotations(declared)
        return np.dtype([(name, _layout(hint)) for name, hint in fields.items()], align=True)
    kind = get_args(declared)[1]
    return np.dtype(kind) if isinstance(kind, str) else np.dtype((_layout(kind.subtype), (kind.length,)))


def _content(layout: np.dtype) -> np.ndarray:
    """Return a byte for each byte of a layout: 255, or 0 for padding."""
    if layout.subdtype is not None:
        element, (length,) = layout.subdtype
        return np.tile(_content(element), length)
    content = np.full(layout.itemsize, 0 if layout.fields else 255, np.uint8)
    for inner, offset, *_ in (layout.fields or {}).values():
        content[offset : offset + inner.itemsize] = _content(inner)
    return content


# The types below are Unitree's unitree_go package; robots and other programs match them by names and structure.


@dataclass
@annotations.final
@annotations.autoid("sequential")
class MotorCmd(idl.IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    """The command of one motor."""

    mode: uint8
    q: float32
    dq: float32
    tau: float32
    kp: float32
    kd: float32
    reserve: array[uint32, 3]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class BmsCmd(idl.IdlStruct, typename="unitree_go.msg.dds_.BmsCmd_"):
    """The command of the battery."""

    off: uint8
    reserve: array[uint8, 3]


@annotations.final
@annotations.autoid("sequential")
class LowCmd(idl.IdlStruct, _Record, typename="unitree_go.msg.dds_.LowCmd_"):
    """A command of all motors; its torque is ``tau + kp (q - measured q) + kd (dq - measured dq)`` in the motor."""

    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    motor_cmd: array[MotorCmd, 20]
    bms_cmd: BmsCmd
    wireless_remote: array[uint8, 40]
    led: array[uint8, 12]
    fan: array[uint8, 2]
    gpio: uint8
    reserve: uint32
    crc: uint32


@dataclass
@annotations.final
@annotations.autoid("sequential")
class IMUState(idl.IdlStruct, typename="unitree_go.msg.dds_.IMUState_"):
    """The inertial measurement unit: quaternion (w, x, y, z), rates [rad/s], acceleration [m/s^2]."""

    quaternion: array[float32, 4]
    gyroscope: array[float32, 3]
    accelerometer: array[float32, 3]
    rpy: array[float32, 3]
    temperature: uint8


@dataclass
@annotations.final
@annotations.autoid("sequential")
class MotorState(idl.IdlStruct, typename="unitree_go.msg.dds_.MotorState_"):
    """The state of one motor: `q` [rad], `dq` [rad/s], `tau_est` [N m]."""

    mode: uint8
    q: float32
    dq: float32
    ddq: float32
    tau_est: float32
    q_raw: float32
    dq_raw: float32
    ddq_raw: float32
    temperature: uint8
    lost: uint32
    reserve: array[uint32, 2]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class BmsState(idl.IdlStruct, typename="unitree_go.msg.dds_.BmsState_"):
    """The battery: state of charge [%], current [mA]."""

    version_high: uint8
    version_low: uint8
    status: uint8
    soc: uint8
    current: int32
    cycle: uint16
    bq_ntc: array[uint8, 2]
    mcu_ntc: array[uint8, 2]
    cell_vol: array[uint16, 15]


@annotations.final
@annotations.autoid("sequential")
class LowState(idl.IdlStruct, _Record, typename="unitree_go.msg.dds_.LowState_"):
    """The state of all motors, the inertial measurement unit, the feet and the battery; `tick` counts milliseconds."""

    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    imu_state: IMUState
    motor_state: array[MotorState, 20]
    bms_state: BmsState
    foot_force: array[int16, 4]
    foot_force_est: array[int16, 4]
    tick: uint32
    wireless_remote: array[uint8, 40]
    bit_flag: uint8
    adc_reel: float32
    temperature_ntc1: uint8
    temperature_ntc2: uint8
    power_v: float32
    power_a: float32
    fan_frequency: array[uint16, 4]
    reserve: uint32
    crc: uint32


def _complete(message: Any, motors: str, padding: int) -> None:
    """Set a message's layout, and let `cyclonedds` encode it as a record.

    The methods are no part of `_Record`, as a class's first base counts as the parent of its type in the IDL.
    """
    message.layout = _layout(message)
    fields: Any = message.layout.fields
    message._cut = fields[motors][1] - padding
    message._content = _content(message.layout)
    message.serialize = lambda self, **_: self.to_wire()
    message.deserialize = lambda data, **_: message.from_wire(data)
    # A writer that leaves sends the fields of a key; these messages have none.
    message.deserialize_key = lambda *_, **__: message()


_complete(LowCmd, "motor_cmd", 2)
_complete(LowState, "motor_state", 3)
