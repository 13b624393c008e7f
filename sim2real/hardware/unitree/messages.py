"""The messages of a Go2's low-level interface, `LowCmd` and `LowState`, as numpy records.

A message is a record in the layout of Unitree's C struct, `message.record`. Its fields have Unitree's names:

    command = LowCmd()
    command.record["motor_cmd"]["q"][:12] = 0.0
    command.sign()
"""

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

import numpy as np

from sim2real.errors import UsageError
from sim2real.installation import with_extra

try:
    from cyclonedds import idl
    from cyclonedds.idl import annotations, types
except ImportError as error:
    raise UsageError("Unitree's robots need cyclonedds, which is not installed", hint=with_extra("unitree")) from error

COMMAND_TOPIC: Final = "rt/lowcmd"
STATE_TOPIC: Final = "rt/lowstate"
MOTORS: Final = 12
"""Motors of a Go2; the messages have 20 places."""
HEAD: Final = (0xFE, 0xEF)
"""The first two bytes of a command."""
LOW_LEVEL: Final = 0xFF
"""`level_flag` of a low-level command, which goes to the motors."""
OFF, SERVO = 0x00, 0x01
"""Modes of a motor: off, and on (it follows `q`, `dq`, `kp`, `kd` and `tau`)."""
NO_POSITION: Final = 2.146e9
"""`q` of a motor without a position controller (Unitree's PosStopF)."""
NO_VELOCITY: Final = 16000.0
"""`dq` of a motor without a velocity controller (Unitree's VelStopF)."""

# The types of Unitree's package unitree_go: each field with its type and number of values. Robots and other programs
# match # types by name and structure. Rates are in rad/s, accelerations in m/s^2, quaternions (w, x, y, z), currents in
# mA, states of charge in %; `tick` counts milliseconds.
_FIELDS: Final = {
    "MotorCmd": "mode u1, q f4, dq f4, tau f4, kp f4, kd f4, reserve u4*3",
    "BmsCmd": "off u1, reserve u1*3",
    "LowCmd": "head u1*2, level_flag u1, frame_reserve u1, sn u4*2, version u4*2, bandwidth u2, motor_cmd MotorCmd*20, "
    "bms_cmd BmsCmd, wireless_remote u1*40, led u1*12, fan u1*2, gpio u1, reserve u4, crc u4",
    "IMUState": "quaternion f4*4, gyroscope f4*3, accelerometer f4*3, rpy f4*3, temperature u1",
    "MotorState": "mode u1, q f4, dq f4, ddq f4, tau_est f4, q_raw f4, dq_raw f4, ddq_raw f4, temperature u1, lost u4, "
    "reserve u4*2",
    "BmsState": "version_high u1, version_low u1, status u1, soc u1, current i4, cycle u2, bq_ntc u1*2, mcu_ntc u1*2, "
    "cell_vol u2*15",
    "LowState": "head u1*2, level_flag u1, frame_reserve u1, sn u4*2, version u4*2, bandwidth u2, imu_state IMUState, "
    "motor_state MotorState*20, bms_state BmsState, foot_force i2*4, foot_force_est i2*4, tick u4, "
    "wireless_remote u1*40, bit_flag u1, adc_reel f4, temperature_ntc1 u1, temperature_ntc2 u1, power_v f4, "
    "power_a f4, fan_frequency u2*4, reserve u4, crc u4",
}
_NUMBERS: Final[dict[str, Any]] = {
    "u1": types.uint8,
    "i2": types.int16,
    "u2": types.uint16,
    "i4": types.int32,
    "u4": types.uint32,
    "f4": types.float32,
}
_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"  # XCDR1
_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32(record: np.ndarray) -> int:
    """Return the CRC of all words but the last (polynomial 0x04c11db7, most significant bit first).

    zlib starts at the least significant bit, so bytes and result are reversed: 2 us for a command and 3 us for a state,
    against 360 us bit by bit in Python.
    """
    big_endian = np.frombuffer(record.tobytes(), "<u4")[:-1].byteswap().tobytes()
    reflected = zlib.crc32(big_endian.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


def _fields(name: str) -> list[tuple[str, str, int]]:
    """Return the fields of a type: name, type, and number of values; 0: it is not an array."""
    rows = [text.split() for text in _FIELDS[name].split(", ")]
    return [(field, kind.partition("*")[0], int(kind.partition("*")[2] or 0)) for field, kind in rows]


def _layout(name: str) -> np.dtype:
    """Return the layout of a type in C."""
    if name in _NUMBERS:
        return np.dtype(f"<{name}")
    rows = [(field, _layout(kind), (count,) if count else ()) for field, kind, count in _fields(name)]
    return np.dtype(rows, align=True)


def _content(layout: np.dtype) -> np.ndarray:
    """Return a byte for each byte of a layout: 255, or 0 for padding."""
    if layout.subdtype is not None:
        element, (length,) = layout.subdtype
        return np.tile(_content(element), length)
    content = np.full(layout.itemsize, 0 if layout.fields else 255, np.uint8)
    for inner, offset, *_ in (layout.fields or {}).values():
        content[offset : offset + inner.itemsize] = _content(inner)
    return content


def _aligned(offset: int) -> int:
    return (offset + 3) & ~3


class _Record:
    """A message in memory as one numpy record, not as a Python object for each field.

    On the wire (XCDR1) the bytes are those of the C struct, except that no padding precedes the first motor's `mode`:
    `_cut` is the position of this mode on the wire. `_content` is 0 at the bytes of padding.
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
            raise ValueError(f"{len(wire)} bytes that begin with {wire[:2].hex()} are not a {cls.__name__} in XCDR1")
        raw = b"".join((wire[4:cut], bytes(mode - cls._cut), wire[cut : cut + 1], bytes(3), wire[_aligned(cut + 1) :]))
        # The CRC covers padding as zeros, also where the sender has other values.
        return cls((np.frombuffer(raw, np.uint8) & cls._content).view(cls.layout).reshape(()))


def _type(name: str, *bases: type) -> Any:
    """Return the class of a type for `cyclonedds`, for which the first base is the type's parent in the IDL."""
    hints = {}
    for field, kind, count in _fields(name):
        element = _NUMBERS.get(kind) or _type(kind)
        hints[field] = types.array[element, count] if count else element
    meta: Any = type(idl.IdlStruct)
    all_bases = (idl.IdlStruct, *bases)
    space = meta.__prepare__(name, all_bases, typename=f"unitree_go.msg.dds_.{name}_")
    space["__annotations__"].update(hints)
    made = annotations.final(annotations.autoid("sequential")(meta(name, all_bases, space)))
    return made if bases else dataclass(made)


def _message(name: str, motors: str, padding: int) -> Any:
    """Return the class of a message, which `cyclonedds` encodes as a record."""
    message = _type(name, _Record)
    layout: Any = _layout(name)
    message.layout, message._content = layout, _content(layout)
    message._cut = layout.fields[motors][1] - padding
    message.serialize = lambda self, **_: self.to_wire()
    message.deserialize = lambda data, **_: message.from_wire(data)
    # When a writer leaves, it sends the key of a message; these messages have none.
    message.deserialize_key = lambda *_, **__: message()
    return message


if TYPE_CHECKING:

    class LowCmd(_Record, idl.IdlStruct):
        """A command of all motors; a motor's torque is ``tau + kp (q - measured q) + kd (dq - measured dq)``."""

    class LowState(_Record, idl.IdlStruct):
        """The state of all motors, the inertial measurement unit, the feet and the battery."""

else:
    LowCmd = _message("LowCmd", "motor_cmd", 2)
    LowState = _message("LowState", "motor_state", 3)
