"""DYNAMIXEL Protocol 2.0 packets: checksum, byte stuffing, and errors.

    FF FF FD 00 | id | length (2) | instruction | parameters (an error byte first in a status packet) | CRC-16 (2)

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0"; the tests compare it with ROBOTIS' own SDK.
"""

from enum import IntEnum
from typing import Final

from sim2real.hardware.bus.packets import Answer, Instruction, Packet, PacketFormat

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

    def frame(self, servo_id: int, body: bytes) -> bytes:
        """Return the bytes of a packet with a body."""
        # A header inside the body would look like the start of a packet, so a byte is inserted after it (stuffing).
        body = body.replace(*_STUFFED)
        packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc16(packet).to_bytes(2, "little")

    def build_status(self, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
        """Return the bytes of a status packet; see `PacketFormat.build_status`."""
        return self.build(servo_id, Instruction.STATUS, bytes((error,)) + parameters)

    def following(self, prefix: bytearray) -> int | None:
        """Return the content of the length field; None if it is invalid."""
        length = int.from_bytes(prefix[5:7], "little")
        return length if 3 <= length <= MAX_PACKET_LENGTH else None

    def parse(self, packet: bytes) -> Packet:
        """Return the content of a packet, without stuffing."""
        intact = crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")
        body = packet[self.prefix_bytes : -2].replace(_STUFFED[1], _STUFFED[0])
        return Packet(packet[4], body[0], body[1:], intact)

    def answer(self, packet: Packet) -> Answer | None:
        """Return error and data of a status packet."""
        if packet.code != Instruction.STATUS or not packet.parameters:
            return None
        return Answer(packet.servo_id, packet.parameters[0], packet.parameters[1:])


PROTOCOL: Final = Protocol2()
