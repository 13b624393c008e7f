"""Positions that are impossible for a joint: jumps at the end of a turn, and readings that leap away and back."""

import numpy as np

from sim2real.later import Later
from sim2real.leaps import reach_rad

ndimage = Later("scipy.ndimage")
TURN_RAD = 2.0 * np.pi
_SEAM = 0.2
"""A step passes the end of a turn if it differs from a turn by a smaller share."""
_FASTEST_RAD_S = 60.0
"""Highest speed of a joint; a faster step is no motion."""
_SLOWEST_RAD_S = 0.5
"""Least assumed highest speed, for a joint that hardly moves."""
_MIN_READINGS = 16
"""Least number of readings for the detection of leaps."""
_MAX_GLITCHES = 0.02
"""A larger share of readings is no glitch."""
_HALF_S, _HALF_MAX = 0.05, 15
"""A glitch is shorter than the first [s], and than the second [samples]."""


def counted(values: np.ndarray, turn: float) -> np.ndarray:
    """Return angles with counted turns, ``(N, columns)``; columns without jumps by a turn are unchanged.

    Args:
        values: Shape ``(N, columns)``; rows without a number stay so.
        turn: A turn, in the unit of the values.
    """
    angles_counted = np.array(values, np.float64)
    for column in angles_counted.T:
        finite = np.flatnonzero(np.isfinite(column))
        angles = column[finite]
        if angles.size < 3 or np.ptp(np.clip(angles, *np.quantile(angles, (0.02, 0.98)))) > turn * (1 + 0.1 * _SEAM):
            continue
        steps = np.diff(angles)
        # At the end of a turn, a step differs from a turn by the motion; the other steps give its size.
        motion = np.abs(steps[np.abs(steps) < 0.5 * turn])
        play = min(_SEAM, 0.02 + 2.0 * float(np.quantile(motion, 0.99)) / turn) * turn if motion.size else 0.0
        if (np.abs(np.abs(steps) - turn) < play).any():
            column[finite] = np.unwrap(angles, period=turn)
    return angles_counted


def turns(values: np.ndarray, turn: float) -> np.ndarray:
    """Return whether a column jumps at the end of a turn, ``(columns,)``."""
    return np.asarray((np.nan_to_num(counted(values, turn)) != np.nan_to_num(values)).any(axis=0))


def same_turn(angle: np.ndarray, t_s: np.ndarray, reference: np.ndarray, t_reference_s: np.ndarray) -> np.ndarray:
    """Return angles shifted by whole turns to the turn of a reference, ``(N, columns)``.

    Args:
        angle: Shape ``(N, columns)`` [rad].
        t_s: Shape ``(N,)`` [s].
        reference: Shape ``(M, columns)`` [rad].
        t_reference_s: Shape ``(M,)`` [s].
    """
    at = np.stack([np.interp(t_s, t_reference_s, column) for column in reference.T], axis=1)
    return angle - TURN_RAD * np.round(np.median(angle - at, axis=0) / TURN_RAD)


def glitches(t_s: np.ndarray, angle: np.ndarray, radian: float = 1.0) -> np.ndarray:
    """Return whether a reading leaps away from its neighbours and back, ``(N, columns)``.

    A joint cannot move farther than its highest speed allows, which is measured on the readings without leaps.

    Args:
        t_s: Shape ``(N,)``, increasing [s].
        angle: Shape ``(N, columns)``, finite, with turns counted.
    """
    leaps_found = np.zeros(angle.shape, bool)
    if len(angle) < _MIN_READINGS:
        return leaps_found
    steps_s = np.diff(t_s)
    period_s = float(np.median(steps_s))
    half = int(np.clip(np.ceil(_HALF_S / period_s), 3, _HALF_MAX))
    for i, column in enumerate((angle / radian).T):
        middle = ndimage.median_filter(column, 2 * half + 1, mode="reflect")
        fastest = max(_SLOWEST_RAD_S, 1.5 * float((np.abs(np.diff(middle)) / steps_s).max()))
        off = np.abs(column - middle)
        leap = np.abs(np.diff(column))
        far = off > reach_rad(fastest, period_s) + 12.0 * float(np.median(off))
        edges = np.flatnonzero(np.diff(far, prepend=False, append=False)).reshape(-1, 2)
        for begin, end in edges:
            # A fast motion has several steps, a leap has one.
            ways = leap[max(begin - 1, 0) : begin], leap[end - 1 : end]
            if max(float(way.max(initial=0.0)) for way in ways) < 0.5 * off[begin:end].max():
                far[begin:end] = False
        leaps_found[:, i] = far if far.mean() <= _MAX_GLITCHES else False
    return leaps_found


def leap(t_s: np.ndarray, angle: np.ndarray, radian: float = 1.0) -> tuple[int, int, float] | None:
    """Return row, column and size [rad] of the first step that is too fast for a joint; None without one.

    Args:
        t_s: Shape ``(N,)``, increasing [s].
        angle: Shape ``(N, columns)``, finite, with turns counted.
    """
    steps = np.abs(np.diff(angle, axis=0)) / radian
    far = steps > reach_rad(_FASTEST_RAD_S, np.diff(t_s))[:, None]
    if not far.any():
        return None
    row, column = (int(x[0]) for x in np.nonzero(far))
    return row + 1, column, float(steps[row, column])
