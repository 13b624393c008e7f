"""What velocities and goals say of the unit of positions: a rate has the unit of what changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import following, on_grid
from sim2real.log.importing.evidence import DEGREES
from sim2real.log.importing.quantities import clean, matched, velocities
from sim2real.log.importing.signals import Signal

_CLOSE = 0.9
"""Correlation from which a unit is told."""
_UNITS = {"rad": 1.0, "deg": DEGREES}


def told_units(
    signals: Sequence[Signal], measured: Signal, command: Signal, t_s: Sequence[np.ndarray], rows: np.ndarray
) -> list[tuple[float, str]]:
    """Return how many units of the positions a radian is by each signal that says so, and how.

    Args:
        measured: Positions, in the order of the joints.
        t_s: Stamps of both [s].
        rows: The samples of the positions that are whole.
    """
    found = [_by_velocity(velocity, measured, t_s[0], rows) for velocity in velocities(signals, measured)]
    if command.meaning.quantity in ("", "position"):
        found.append(_by_goal(measured, command, t_s, rows))
    return [told for told in found if told is not None]


def _by_velocity(velocity: Signal, measured: Signal, t_s: np.ndarray, rows: np.ndarray) -> tuple[float, str] | None:
    own = matched(velocity, measured, np.arange(measured.width))
    rows = rows[own.finite[rows]]
    if len(rows) < 50:
        return None
    rate = np.gradient(measured.values[rows], t_s[rows], axis=0)
    like = following(rate, own.values[rows], float(np.median(np.diff(t_s[rows]))), 0.1)
    slope = np.diag(like.slope)[np.abs(np.diag(like.r)) > _CLOSE]
    ratio = evidence.unit_ratio(slope)
    off = np.abs(slope / (ratio or 1.0))
    if ratio is None or not ((off > 0.6) & (off < 1.7)).all():
        return None
    return _told(velocity, 1 / ratio)


def _by_goal(
    measured: Signal, command: Signal, t_s: Sequence[np.ndarray], rows: np.ndarray
) -> tuple[float, str] | None:
    own = np.flatnonzero(clean(t_s[1], command))
    if min(len(own), len(rows)) < 50:
        return None
    held, joined, period_s = on_grid(t_s[1][own], command.values[own], t_s[0][rows], measured.values[rows])
    if len(held) < 50:
        return None
    like = following(held, joined, period_s)
    best = np.abs(like.r).argmax(axis=1)
    at = np.arange(len(best)), best
    slope = np.abs(like.slope[at][np.abs(like.r[at]) > _CLOSE])
    ratio = evidence.unit_ratio(slope)
    # A position that stays far behind its goal may have any unit, unless a name says that of the goal.
    weak = ratio is not None and not 0.6 < float(np.median(slope)) / ratio < 1.7
    if ratio is None or (weak and ratio != 1.0):
        return None
    return _told(command, ratio)


def _told(by: Signal, ratio: float) -> tuple[float, str] | None:
    """Return the unit of positions that are ``ratio`` times another signal, and why; None where nothing is told."""
    known = _UNITS.get(by.meaning.unit)
    if known is None:
        # One of both is in degrees; where they are alike, nothing is told.
        return None if ratio == 1.0 else (max(ratio, 1.0), f"{by.name!r} is {1 / ratio:.3g} of it: one is in degrees")
    unit = known * ratio
    fits = [u for u in _UNITS.values() if np.isclose(u, unit)]
    return (fits[0], f"{by.name!r}, in {by.meaning.unit} by its name, is {1 / ratio:.3g} of it") if fits else None
