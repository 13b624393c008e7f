"""Packets on a half-duplex bus of servos: shared code, and the abstract format that each family defines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

if TYPE_CHECKING:
    from sim2real.hardware.bus.registers import Register

BROADCAST_ID: Final = 0xFE


class Instruction(IntEnum):
    """Instruction byte of a packet; the numbers are DYNAMIXEL's, which other families copied."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True)
class Packet:
    """A received packet.

    Args:
        servo_id: Receiver, or the sender of a status packet.
        code: Instruction byte, also one outside of `Instruction`; in status packets of some families the error byte.
        parameters: Bytes between code and checksum, without stuffing.
        intact: Whether the checksum matches; if not, the other fields may be wrong.
    """

    servo_id: int
    code: int
    parameters: bytes = b""
    intact: bool = True


class Answer(NamedTuple):
    """Content of a status packet: the servo, its error byte (0: no error), and the read data."""

    servo_id: int
    error: int
    data: bytes


class PacketFormat(ABC):
    """The packet format of a family of servos.

    Attributes:
        header: The first bytes of every packet.
        prefix_bytes: Number of bytes up to the end of the length field.
        answer_bytes: Number of bytes of a status packet without data.
        address_bytes: Number of bytes of an address, and of a length in an instruction.
        refusals: Bits of the error byte of a refused instruction; such an answer has no data.
        off_errors: Possible error bytes of an answer that confirms that torque is off.
        ping_bytes: Number of data bytes of the answer to a ping.
    """

    header: ClassVar[bytes]
    prefix_bytes: ClassVar[int]
    answer_bytes: ClassVar[int]
    address_bytes: ClassVar[int]
    refusals: ClassVar[int] = 0
    off_errors: ClassVar[tuple[int, ...]] = (0,)
    ping_bytes: ClassVar[int] = 0

    @abstractmethod
    def frame(self, servo_id: int, body: bytes) -> bytes:
        """Return the bytes of a packet whose body has the code and the parameters."""

    def build(self, servo_id: int, code: int, parameters: bytes = b"") -> bytes:
        """Return the bytes of a packet on the wire; arguments as in `Packet`."""
        return self.frame(servo_id, bytes((code,)) + parameters)

    def build_status(self, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
        """Return the bytes of a status packet, the answer of a servo."""
        return self.build(servo_id, error, parameters)

    @abstractmethod
    def following(self, prefix: bytearray) -> int | None:
        """Return the number of bytes after a packet's first `prefix_bytes`; None if the prefix is invalid."""

    @abstractmethod
    def parse(self, packet: bytes) -> Packet:
        """Return the content of a whole packet."""

    @abstractmethod
    def answer(self, packet: Packet) -> Answer | None:
        """Return the content of a status packet; None for any other packet."""

    def read(self, servo_ids: Sequence[int], address: int, length: int) -> bytes:
        """Return the instruction that reads the same bytes of one or several servos."""
        place = self._word(address) + self._word(length)
        if len(servo_ids) == 1:
            return self.build(servo_ids[0], Instruction.READ, place)
        return self.build(BROADCAST_ID, Instruction.SYNC_READ, place + bytes(servo_ids))

    def write(self, servo_id: int, register: Register, value: int) -> bytes:
        """Return the instruction that writes a register."""
        return self.build(servo_id, Instruction.WRITE, self._word(register.address) + register.encode(value))

    def write_each(self, register: Register, values: Mapping[int, int]) -> bytes:
        """Return the instruction that writes a register of several servos, id -> value; no servo answers it."""
        items = b"".join(bytes((i,)) + register.encode(value) for i, value in values.items())
        place = self._word(register.address) + self._word(register.size)
        return self.build(BROADCAST_ID, Instruction.SYNC_WRITE, place + items)

    def torque_queries(self, torque: Register, servo_ids: Sequence[int]) -> list[tuple[bytes, list[bytes]]]:
        """Return for each servo the instruction that reads its torque register, and the answers that mean "off"."""
        return [
            (
                self.read((i,), torque.address, torque.size),
                [self.build_status(i, error, torque.encode(0)) for error in self.off_errors],
            )
            for i in servo_ids
        ]

    def word(self, data: bytes, position: int) -> int:
        """Return the address, or the number of bytes, that stands at a position in a packet's parameters."""
        return int.from_bytes(data[position : position + self.address_bytes], "little")

    def _word(self, value: int) -> bytes:
        return value.to_bytes(self.address_bytes, "little")


class Parser:
    """Finds packets in a byte stream that arrives in chunks, and resynchronises after garbage."""

    def __init__(self, form: PacketFormat) -> None:
        self._form = form
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget the beginning of an incomplete packet."""
        self._buffer.clear()

    def feed(self, chunk: bytes) -> list[tuple[Packet, int]]:
        """Return the packets that a chunk completes, each with the position of its end in the chunk [bytes]."""
        held_bytes = len(self._buffer)
        self._buffer += chunk
        taken_bytes = 0
        packets = []
        while (item := self._next()) is not None:
            packet, used_bytes = item
            taken_bytes += used_bytes
            if packet is not None:
                packets.append((packet, max(0, taken_bytes - held_bytes)))
        return packets

    def _next(self) -> tuple[Packet | None, int] | None:
        """Remove a packet or leading garbage; return it (or None) and its size in bytes, None if more are needed."""
        buffer, form = self._buffer, self._form
        # Find the header, and drop the garbage before it.
        start = buffer.find(form.header)
        if start != 0:
            # The last bytes may be the beginning of a header.
            garbage_bytes = start if start > 0 else max(0, len(buffer) - len(form.header) + 1)
            return self._drop(garbage_bytes) if garbage_bytes else None
        # Wait for the length field, then for the whole packet.
        if len(buffer) < form.prefix_bytes:
            return None
        following = form.following(buffer)
        if following is None:  # the prefix is invalid: a header may begin one byte later
            return self._drop(1)
        end = form.prefix_bytes + following
        if len(buffer) < end:
            return None
        packet = form.parse(bytes(buffer[:end]))
        # After a wrong checksum, drop only the header: the length may be wrong, too, and span good packets.
        return packet, self._drop(end if packet.intact else len(form.header))[1]

    def _drop(self, count: int) -> tuple[None, int]:
        del self._buffer[:count]
        return None, count
