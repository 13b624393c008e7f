"""Packets that take the torque off and ask whether it is, for the guardian and for `make_safe`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.protocol import ALARMS, StsInstruction, build, sync_write

_TORQUE = reg.TORQUE_ENABLE


def torque_off_packet(ids: Sequence[int]) -> bytes:
    """Return the instruction that takes the torque of all servos off, which they do not answer."""
    return sync_write(_TORQUE.address, {i: b"\0" for i in ids})


def torque_queries(ids: Sequence[int]) -> list[tuple[bytes, list[bytes]]]:
    """Return for each servo the instruction that asks for its torque, and the answers that mean "off", by alarms."""
    masks = [sum(1 << bit for bit in bits) for n in range(len(ALARMS) + 1) for bits in combinations(ALARMS, n)]
    read = bytes((_TORQUE.address, _TORQUE.size))
    return [(build(i, StsInstruction.READ, read), [build(i, mask, b"\0") for mask in masks]) for i in ids]
