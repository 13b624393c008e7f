"""Feetech's packets: checksum, and the alarms that every answer carries.

    FF FF | id | length | instruction (status packet: error byte) | parameters | checksum

The length counts the bytes after it; the checksum is the inverted low byte of the sum of all bytes from the id on.
There is no stuffing: a header may occur inside a packet.

Sources: Feetech, "Servo SCS Communication Protocol" (its examples are in the tests); scservo_sdk of PyPI's
feetech-servo-sdk 1.0.0, for the meaning of the error byte's bits.
"""

from itertools import combinations
from typing import Final

from sim2real.hardware.bus.packets import BROADCAST_ID, Answer, Packet, PacketFormat

HEADER: Final = b"\xff\xff"

ALARMS: Final[dict[int, str]] = {0: "input voltage", 1: "encoder", 2: "overheating", 3: "overcurrent", 5: "overload"}
"""Bit of the error byte, and of the register Status -> its name. Every status packet carries them."""


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
        """Return the bytes of a packet with a body of at most 252 bytes."""
        summed = bytes((servo_id, len(body) + 1)) + body
        return HEADER + summed + bytes((checksum(summed),))

    def following(self, prefix: bytearray) -> int | None:
        """Return the content of the length field; None if it or the id is invalid."""
        return prefix[3] if prefix[2] <= BROADCAST_ID and prefix[3] >= 2 else None

    def parse(self, packet: bytes) -> Packet:
        """Return the content of a packet."""
        return Packet(packet[2], packet[4], packet[5:-1], checksum(packet[2:-1]) == packet[-1])

    def answer(self, packet: Packet) -> Answer:
        """Return error and data of a status packet, which has the same form as an instruction."""
        return Answer(packet.servo_id, packet.code, packet.parameters)


PROTOCOL: Final = StsProtocol()
