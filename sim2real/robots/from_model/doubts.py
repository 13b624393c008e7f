"""Recordings that a model cannot have: positions beyond the ranges of joints, open loops, payloads that change."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.types import MjModel
from sim2real.worlds.driven import OF_PAYLOAD

_CHECKED, _OPEN = 100, 5e-3
"""Number of recorded positions at which loops must close, and the largest error of a closed one [m or rad]."""
_WIDER = 1.1
"""Ratio of a joint's motion to its range from which the range is wrong, whichever zero the log has."""
_BEYOND, _OFTEN = 0.1, 0.05
"""How far beyond a range positions count, as a share of its width; share of samples there from which they do."""


def beyond_ranges(model: MjModel, joints: Sequence[str], position: np.ndarray, file: str) -> list[str]:
    """Return a sentence on joints whose recorded positions ``(N, joints)`` often lie beyond the model's range.

    Raises:
        UsageError: When a joint moves further than its range is wide.
    """
    sentences = []
    for i, joint in enumerate(joints):
        number = model.joint(joint).id
        low, high = model.jnt_range[number]
        if not model.jnt_limited[number]:
            continue
        first, last = np.nanquantile(position[:, i], (0.02, 0.98))
        moves = f"{joint} goes from {first:.3g} to {last:.3g} in the log, and its range in {file} is {low:.3g} to"
        if last - first > _WIDER * (high - low):
            raise UsageError(
                f"{moves} {high:.3g}: the model cannot move that far",
                hint='MJCF takes ranges in degrees, unless it has <compiler angle="radian"/>; or check the log\'s unit',
            )
        room = _BEYOND * (high - low)
        often = float(np.mean((position[:, i] < low - room) | (position[:, i] > high + room)))
        if often > _OFTEN:
            sentences.append(f"{moves} {high:.3g}: it lies beyond in {often:.0%} of the samples; check zero and sign")
    return sentences


def open_loops(
    gaps_of: Callable[[np.ndarray], np.ndarray], position: np.ndarray, joints: Sequence[str], file: str
) -> list[str]:
    """Return a sentence on recorded positions ``(N, joints)`` at which a loop of the model cannot close."""
    some = position[:: max(len(position) // _CHECKED, 1)]
    gaps = gaps_of(some)
    if not (stays := gaps > _OPEN).any():
        return []
    worst = ", ".join(f"{n} {x:.3g}" for n, x in zip(joints, some[gaps.argmax()], strict=True))
    return [
        f"the loops of {file} cannot close at {stays.mean():.0%} of the recorded positions; the largest gap is "
        f"{gaps.max():.3g} (m or rad), at {worst}: check order, signs, units and zeros of the joints"
    ]


def check_payload(sent: Mapping[str, np.ndarray], commands: Collection[str]) -> None:
    """Raise an error if the payload changes within a log, or is no mass.

    Args:
        sent: The log's commands by field.
        commands: Fields that the robot reads.
    """
    if "payload_reach" in commands and "payload" not in commands:
        raise Sim2RealError("the log has a payload_reach and no payload", hint="map the mass, too, as payload [kg]")
    for field in (f for f in OF_PAYLOAD if f in sent and f in commands):
        values = np.unique(sent[field])
        if len(values) > 1 or not np.all(values >= 0.0):
            listed = ", ".join(f"{v:g}" for v in values[:4])
            raise Sim2RealError(
                f"{field} is {listed} {OF_PAYLOAD[field]}: a log has one payload, of 0 or more",
                hint="cut the log where the payload changes, or remove the field from the mapping",
            )
