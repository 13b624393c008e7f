"""Feetech's packets: checksum, building, and parsing of a stream with errors.

    FF FF | id | length | instruction (status packet: error byte) | parameters | checksum

Length counts what follows it; the checksum is the inverted low byte of the sum of everything from the id on. Nothing is
stuffed: a header may occur inside a packet.

Sources: Feetech, "Servo SCS Communication Protocol" (its examples are in the tests); scservo_sdk of PyPI's
feetech-servo-sdk 1.0.0, for the meaning of the error byte's bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

HEADER: Final = b"\xff\xff"
BROADCAST_ID: Final = 0xFE
FRAME_BYTES: Final = 6
"""Bytes of a packet without parameters."""

ALARMS: Final[dict[int, str]] = {
    0: "input voltage",
    1: "encoder",
    2: "overheating",
    3: "overcurrent",
    5: "overload",
}
"""Bit of the error byte, and of the register Status -> its name. Every status packet carries them."""


class StsInstruction(IntEnum):
    """Instruction byte of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESTART = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True)
class StsPacket:
    """A packet that was received.

    Args:
        servo_id: Receiver, or the sender of a status packet.
        code: StsInstruction, not necessarily one of `Instruction`; the error byte of a status packet.
        parameters: Bytes between code and checksum.
        checksum_ok: Whether the checksum matches; if not, the other fields may be wrong.
    """

    servo_id: int
    code: int
    parameters: bytes = b""
    checksum_ok: bool = True


def checksum(body: bytes | bytearray) -> int:
    """Return the checksum of a packet's bytes from id to last parameter."""
    return ~sum(body) & 0xFF


def build(servo_id: int, code: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a packet.

    Args:
        servo_id: The receiver; of a status packet, the sender.
        code: Instruction; of a status packet, the error byte.
        parameters: Bytes after it, at most 251.
    """
    body = bytes((servo_id, len(parameters) + 2, code)) + parameters
    return HEADER + body + bytes((checksum(body),))


def sync_write(address: int, values: dict[int, bytes]) -> bytes:
    """Return the instruction that writes a register of several servos, which they do not answer.

    Args:
        address: Address of the register's first byte.
        values: Servo id -> the register's bytes, as many for each.
    """
    size = len(next(iter(values.values())))
    items = b"".join(bytes((servo_id,)) + data for servo_id, data in values.items())
    return build(BROADCAST_ID, StsInstruction.SYNC_WRITE, bytes((address, size)) + items)


def describe_alarms(bits: int) -> str:
    """Return the names of the alarms in an error byte, or "none"."""
    return ", ".join(ALARMS.get(bit, f"bit {bit}") for bit in range(8) if bits >> bit & 1) or "none"


class StsParser:
    """Finds packets in a byte stream that arrives in chunks, and resynchronises after garbage."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget the beginning of an incomplete packet."""
        self._buffer.clear()

    def feed(self, chunk: bytes) -> list[tuple[StsPacket, int]]:
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

    def _next(self) -> tuple[StsPacket | None, int] | None:
        """Remove a packet or leading garbage; return it (or None) and its size in bytes, None if more are needed."""
        buffer = self._buffer
        start = buffer.find(HEADER)
        if start != 0:
            # The last byte may be the beginning of a header.
            garbage_bytes = start if start > 0 else max(0, len(buffer) - 1)
            del buffer[:garbage_bytes]
            return (None, garbage_bytes) if garbage_bytes else None
        if len(buffer) < 4:
            return None
        end = 4 + buffer[3]
        if buffer[2] > BROADCAST_ID or buffer[3] < 2:  # no id, or too short: the header begins one byte later, if any
            del buffer[:1]
            return None, 1
        if len(buffer) < end:
            return None
        ok = checksum(buffer[2 : end - 1]) == buffer[end - 1]
        packet = StsPacket(buffer[2], buffer[4], bytes(buffer[5 : end - 1]), ok)
        # After a wrong checksum, drop the header only: the length may be wrong too, and include good packets.
        used_bytes = end if ok else len(HEADER)
        del buffer[:used_bytes]
        return packet, used_bytes
