"""Positions that no joint can have had: angles that jump at the end of a turn, and readings that leap away and back."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from sim2real.leaps import reach_rad

TURN_RAD = 2.0 * np.pi
_SEAM = 0.2
"""A step is one over the end of a turn, if it is a turn but for this share."""
_FASTEST_RAD_S = 60.0
"""No joint is faster; a step that would need more is none of a motion."""
_SLOWEST_RAD_S = 0.5
"""The fastest speed of a joint that hardly moves is taken to be this."""
_FEWEST = 16
"""Fewer readings do not show what is usual."""
_RARE = 0.02
"""More readings than this share are no glitches."""
_HALF_S, _HALF_MOST = 0.05, 15
"""A glitch is shorter than this [s], and than so many samples."""


def counted(values: np.ndarray, turn: float) -> np.ndarray:
    """Return angles with their turns counted, ``(N, columns)``; columns that do not jump by a turn stay as they are.

    Args:
        values: Shape ``(N, columns)``; rows without a number stay so.
        turn: A turn, in the unit of the values.
    """
    found = np.array(values, np.float64)
    for column in found.T:
        good = np.flatnonzero(np.isfinite(column))
        angles = column[good]
        if angles.size < 3 or np.ptp(np.clip(angles, *np.quantile(angles, (0.02, 0.98)))) > turn * (1 + 0.1 * _SEAM):
            continue
        steps = np.diff(angles)
        # Over the end of a turn a step is a turn but for the motion, which the other steps show.
        motion = np.abs(steps[np.abs(steps) < 0.5 * turn])
        play = min(_SEAM, 0.02 + 2.0 * float(np.quantile(motion, 0.99)) / turn) * turn if motion.size else 0.0
        if (np.abs(np.abs(steps) - turn) < play).any():
            column[good] = np.unwrap(angles, period=turn)
    return found


def turns(values: np.ndarray, turn: float) -> np.ndarray:
    """Return which columns jump at the end of a turn, ``(columns,)``."""
    return np.asarray((np.nan_to_num(counted(values, turn)) != np.nan_to_num(values)).any(axis=0))


def same_turn(angle: np.ndarray, t_s: np.ndarray, reference: np.ndarray, t_reference_s: np.ndarray) -> np.ndarray:
    """Return angles that were counted from another turn than those of a reference, in its turn, ``(N, columns)``.

    Args:
        angle: Shape ``(N, columns)`` [rad].
        t_s: Shape ``(N,)`` [s].
        reference: Shape ``(M, columns)`` [rad].
        t_reference_s: Shape ``(M,)`` [s].
    """
    at = np.stack([np.interp(t_s, t_reference_s, column) for column in reference.T], axis=1)
    return angle - TURN_RAD * np.round(np.median(angle - at, axis=0) / TURN_RAD)


def glitches(t_s: np.ndarray, angle: np.ndarray, radian: float = 1.0) -> np.ndarray:
    """Return which readings leap away from those around them and back, ``(N, columns)``.

    The rule is that of a recording: a joint cannot have moved farther than its fastest speed takes it, which is that of
    the readings without the leaps.

    Args:
        t_s: Shape ``(N,)``, increasing [s].
        angle: Shape ``(N, columns)``, finite, with turns counted.
    """
    found = np.zeros(angle.shape, bool)
    if len(angle) < _FEWEST:
        return found
    steps_s = np.diff(t_s)
    period_s = float(np.median(steps_s))
    half = int(np.clip(np.ceil(_HALF_S / period_s), 3, _HALF_MOST))
    for i, column in enumerate((angle / radian).T):
        middle = median_filter(column, 2 * half + 1, mode="reflect")
        fastest = max(_SLOWEST_RAD_S, 1.5 * float((np.abs(np.diff(middle)) / steps_s).max()))
        off = np.abs(column - middle)
        leap = np.abs(np.diff(column))
        far = off > reach_rad(fastest, period_s) + 12.0 * float(np.median(off))
        edges = np.flatnonzero(np.diff(far, prepend=False, append=False)).reshape(-1, 2)
        for begin, end in edges:
            # A fast motion goes there in steps, a leap in one.
            ways = leap[max(begin - 1, 0) : begin], leap[end - 1 : end]
            if max(float(way.max(initial=0.0)) for way in ways) < 0.5 * off[begin:end].max():
                far[begin:end] = False
        found[:, i] = far if far.mean() <= _RARE else False
    return found


def leap(t_s: np.ndarray, angle: np.ndarray, radian: float = 1.0) -> tuple[int, int, float] | None:
    """Return row, column and size [rad] of the first step that no joint is fast enough for; None where there is none.

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
