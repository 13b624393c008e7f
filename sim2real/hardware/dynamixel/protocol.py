"""DYNAMIXEL Protocol 2.0 packets: checksum, byte stuffing, building, and parsing of a stream with errors.

    FF FF FD 00 | id | length (2) | instruction | parameters (an error byte first in a status packet) | CRC-16 (2)

The host uses ROBOTIS' own SDK; this module serves the emulated servos and the guardian.
Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

HEADER: Final = b"\xff\xff\xfd\x00"
BROADCAST_ID: Final = 0xFE
MAX_ID: Final = 0xFC
MAX_PACKET_LENGTH: Final = 1024
ALERT_BIT: Final = 0x80  # set in a status packet's error byte while Hardware Error Status is not 0

_PREFIX_BYTES: Final = 7  # header, id, length
_STUFFED: Final = (b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


class Instruction(IntEnum):
    """Instruction byte of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    BULK_READ = 0x92


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


@dataclass(frozen=True)
class Packet:
    """A packet that was received.

    Args:
        servo_id: Receiver, or the sender of a status packet.
        instruction: Instruction byte, not necessarily one of `Instruction`.
        parameters: Bytes between instruction and checksum, without stuffing.
        crc_ok: Whether the checksum matches; if not, the other fields may be wrong.
    """

    servo_id: int
    instruction: int
    parameters: bytes = b""
    crc_ok: bool = True


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


def build(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction packet, as sent on the wire.

    Args:
        servo_id: The receiver.
        instruction: Instruction byte.
        parameters: Bytes after it.
    """
    # A header inside the body would look like the start of a packet, so a byte is inserted after it (stuffing).
    body = (bytes((instruction,)) + parameters).replace(*_STUFFED)
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def build_status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet, a servo's answer.

    Args:
        servo_id: The sender.
        error: Error byte.
        parameters: Bytes after it.
    """
    return build(servo_id, Instruction.STATUS, bytes((error,)) + parameters)


class Parser:
    """Finds packets in a byte stream that arrives in chunks, and resynchronises after garbage."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget the beginning of an incomplete packet."""
        self._buffer.clear()

    def feed(self, chunk: bytes) -> list[tuple[Packet, int]]:
        """Process the next bytes.

        Args:
            chunk: The bytes.

        Returns:
            The packets that they complete; each with the number of bytes of `chunk` up to and with its last byte.
        """
        held_bytes = len(self._buffer)
        self._buffer += chunk
        taken_bytes = 0
        packets = []
        while (found := self._next()) is not None:
            packet, used_bytes = found
            taken_bytes += used_bytes
            if packet is not None:
                packets.append((packet, max(0, taken_bytes - held_bytes)))
        return packets

    def _next(self) -> tuple[Packet | None, int] | None:
        """Remove a packet or leading garbage; return it (or None) and its size in bytes, None if more are needed."""
        buffer = self._buffer
        start = buffer.find(HEADER)
        if start != 0:
            # The last three bytes may be the beginning of a header.
            garbage_bytes = start if start > 0 else max(0, len(buffer) - len(HEADER) + 1)
            del buffer[:garbage_bytes]
            return (None, garbage_bytes) if garbage_bytes else None
        if len(buffer) < _PREFIX_BYTES:
            return None
        length = int.from_bytes(buffer[5:7], "little")
        if not 3 <= length <= MAX_PACKET_LENGTH:
            del buffer[: len(HEADER)]
            return None, len(HEADER)
        end = _PREFIX_BYTES + length
        if len(buffer) < end:
            return None
        crc_ok = crc16(buffer[: end - 2]) == int.from_bytes(buffer[end - 2 : end], "little")
        body = bytes(buffer[_PREFIX_BYTES : end - 2]).replace(_STUFFED[1], _STUFFED[0])
        packet = Packet(buffer[4], body[0], body[1:], crc_ok)
        # After a wrong checksum, drop the header only: the length may be wrong too, and include good packets.
        used_bytes = end if crc_ok else len(HEADER)
        del buffer[:used_bytes]
        return packet, used_bytes
