"""Packets that take the torque off and ask whether it is, for the guardian and for `make_safe`."""

from __future__ import annotations

from collections.abc import Sequence

from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import ALERT_BIT, BROADCAST_ID, Instruction, build, build_status

_TORQUE = reg.TORQUE_ENABLE.address.to_bytes(2, "little") + reg.TORQUE_ENABLE.size.to_bytes(2, "little")


def torque_off_packet(ids: Sequence[int]) -> bytes:
    """Return the instruction that takes the torque of all servos off, which they do not answer."""
    return build(BROADCAST_ID, Instruction.SYNC_WRITE, _TORQUE + b"".join(bytes((i, 0)) for i in ids))


def torque_queries(ids: Sequence[int]) -> list[tuple[bytes, list[bytes]]]:
    """Return for each servo the instruction that asks for its torque, and the two answers that mean "off"."""
    return [
        (build(i, Instruction.READ, _TORQUE), [build_status(i, error, b"\0") for error in (0, ALERT_BIT)]) for i in ids
    ]
