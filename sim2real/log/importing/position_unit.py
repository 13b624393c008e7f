"""The unit of positions from velocities and goals, whose units are related to it."""

from collections.abc import Sequence

import numpy as np

from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import following, on_grid
from sim2real.log.importing.evidence import DEGREES
from sim2real.log.importing.quantities import clean, matched, velocities
from sim2real.log.importing.signals import Signal

_MIN_R = 0.9
"""A signal determines the unit from this correlation on."""
_UNITS = {"rad": 1.0, "deg": DEGREES}


def units_from_signals(
    signals: Sequence[Signal], measured: Signal, command: Signal, t_s: Sequence[np.ndarray], rows: np.ndarray
) -> list[tuple[float, str]]:
    """Return the number of position units in a radian, and the reason, for each signal that determines it.

    Args:
        measured: Positions, in the order of the joints.
        t_s: Stamps of both [s].
        rows: The samples of the positions without a missing number.
    """
    units = [_by_velocity(velocity, measured, t_s[0], rows) for velocity in velocities(signals, measured)]
    if command.meaning.quantity in ("", "position"):
        units.append(_by_goal(measured, command, t_s, rows))
    return [unit for unit in units if unit is not None]


def _by_velocity(velocity: Signal, measured: Signal, t_s: np.ndarray, rows: np.ndarray) -> tuple[float, str] | None:
    matching = matched(velocity, measured, np.arange(measured.width))
    rows = rows[matching.finite[rows]]
    if len(rows) < 50:
        return None
    rate = np.gradient(measured.values[rows], t_s[rows], axis=0)
    relation = following(rate, matching.values[rows], float(np.median(np.diff(t_s[rows]))), 0.1)
    slope = np.diag(relation.slope)[np.abs(np.diag(relation.r)) > _MIN_R]
    ratio = evidence.unit_ratio(slope)
    error = np.abs(slope / (ratio or 1.0))
    if ratio is None or not ((error > 0.6) & (error < 1.7)).all():
        return None
    return _unit_from(velocity, 1 / ratio)


def _by_goal(
    measured: Signal, command: Signal, t_s: Sequence[np.ndarray], rows: np.ndarray
) -> tuple[float, str] | None:
    command_rows = np.flatnonzero(clean(t_s[1], command))
    if min(len(command_rows), len(rows)) < 50:
        return None
    held, joined, period_s = on_grid(
        t_s[1][command_rows], command.values[command_rows], t_s[0][rows], measured.values[rows]
    )
    if len(held) < 50:
        return None
    relation = following(held, joined, period_s)
    best = np.abs(relation.r).argmax(axis=1)
    at = np.arange(len(best)), best
    slope = np.abs(relation.slope[at][np.abs(relation.r[at]) > _MIN_R])
    ratio = evidence.unit_ratio(slope)
    # A position far behind its goal can have any unit, unless the goal's name has a unit.
    weak = ratio is not None and not 0.6 < float(np.median(slope)) / ratio < 1.7
    if ratio is None or (weak and ratio != 1.0):
        return None
    return _unit_from(command, ratio)


def _unit_from(by: Signal, ratio: float) -> tuple[float, str] | None:
    """Return the unit of positions that are ``ratio`` times another signal, and the reason; None if it is open."""
    named_unit = _UNITS.get(by.meaning.unit)
    if named_unit is None:
        # One of both is in degrees; equal units leave the unit open.
        return None if ratio == 1.0 else (max(ratio, 1.0), f"{by.name!r} is {1 / ratio:.3g} of it: one is in degrees")
    unit = named_unit * ratio
    fits = [u for u in _UNITS.values() if np.isclose(u, unit)]
    return (fits[0], f"{by.name!r}, in {by.meaning.unit} by its name, is {1 / ratio:.3g} of it") if fits else None
