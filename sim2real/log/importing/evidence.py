"""What the numbers of a recording say by themselves: what follows what, how late, with which sign, in which unit."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from sim2real.log.importing.command_response import Following, following, on_grid

DEGREES = 180.0 / np.pi
SURE = 0.6
"""Correlation from which a column is said to follow another."""
EQUAL_R, EQUAL_SLOPE = 0.95, 0.9
"""A column whose correlation and slope, in one unit, are above these equals another but for a lag."""
_UNLIKE = 10.0
"""Distance of a column that moves from one that does not."""
_COPIED_ROWS = 3
"""So many samples beside a measurement its copy is looked for among commands."""


def order(found: Following, scale: float = 1.0) -> np.ndarray:
    """Return the command of each measured column, ``(M,)``, so that together they are closest.

    What is as close in the given order keeps it: commands that are alike cannot be told apart, and need not be.
    """
    # What moves belongs to what moves; of what rests, nothing is known.
    rests = np.equal.outer(*(~found.moved.any(axis=axis) for axis in (1, 0)))
    distance = np.where(found.moved, found.by_level(scale).distance(scale), np.where(rests, 1.0, _UNLIKE))
    own = np.diag(distance)
    # What moves alike may differ in anything but noise: a tenth of the distance does not count.
    best = linear_sum_assignment(distance - 0.1 * np.diag(own) - 1e-6 * np.eye(len(own)))[1]
    kept = np.arange(len(own))
    for loop in _loops(best):
        gain = own[loop].sum() - distance[loop, best[loop]].sum()
        if gain > 0.5 * own[loop].sum() and gain > 0.02 * len(loop):
            kept[loop] = best[loop]
    return kept


def open_pairs(found: Following, scale: float = 1.0) -> list[tuple[int, int]]:
    """Return pairs of columns whose commands may as well be exchanged, although that would change what is imported.

    Args:
        found: Of as many commands as measurements, in the order that was found.
    """
    found = found.by_level(scale)
    distance, lag = found.distance(scale), found.lag_s
    typical = float(np.median(np.diag(lag)))
    found_open = []
    for i, k in combinations(np.flatnonzero(found.moved.all(axis=1)), 2):
        here, there = (i, i), (k, k)
        swapped = [(i, k), (k, i)]
        if np.abs([found.r[at] for at in swapped]).min() < SURE:
            continue
        kept, other = (sum(distance[at] for at in pair) for pair in ([here, there], swapped))
        misfits = [sum(1 - found.r[at] ** 2 for at in pair) for pair in ([here, there], swapped)]
        if other > 1.5 * kept + 0.02 or misfits[1] > 1.5 * misfits[0] + 0.01:
            continue
        off = [max(abs(lag[at] - typical) for at in pair) for pair in ([here, there], swapped)]
        same = all(np.sign(found.r[a]) == np.sign(found.r[b]) for a, b in zip(swapped, (here, there), strict=True))
        alike = same and off[1] <= off[0] + 1.5 * found.period_s
        # Joints share the delay of their robot: an order in which lags differ more is not the right one.
        if not alike and off[1] < 2.0 * off[0] + 3.0 * found.period_s:
            found_open.append((int(i), int(k)))
    return found_open


def unit_ratio(slopes: np.ndarray) -> float | None:
    """Return the ratio of two signals' units, of radians and degrees, by their slopes; None where it is none of these.

    Args:
        slopes: Of measurements over the commands that they follow, ``(N,)``, of either sign.
    """
    if not slopes.size:
        return None
    typical = float(np.median(np.abs(slopes)))
    # A weak servo stays far behind its goal, but none goes far beyond.
    close = [k for k in (1.0, DEGREES, 1 / DEGREES) if 0.15 < typical / k < 4.0]
    return close[0] if close else None


def turn(values: np.ndarray) -> tuple[str, int] | None:
    """Return unit and counts a turn of the encoder whose steps show in positions; None where none do.

    Args:
        values: Positions, ``(N,)``.
    """
    levels = np.unique(np.round(values, 9))
    if not 5 <= levels.size < 0.8 * values.size + 5:
        return None
    steps = np.diff(levels)
    step = float(np.median(steps[steps > 1e-7])) if (steps > 1e-7).any() else 0.0
    if not step or np.mean(np.abs(steps / step - np.round(steps / step)) > 0.05) > 0.1:
        return None
    for unit, whole in (("rad", 2 * np.pi), ("deg", 360.0)):
        counts = whole / step
        known = [n for n in (*(1 << b for b in range(8, 24)), 1000, 2000, 4000, 10_000) if abs(counts / n - 1) < 2e-3]
        if known:
            return unit, known[0]
    return None


def _loops(order: np.ndarray) -> list[np.ndarray]:
    """Return the loops of a permutation that are longer than one."""
    seen: set[int] = set()
    found = []
    for start in range(len(order)):
        loop, at = [], start
        while at not in seen:
            seen.add(at)
            loop.append(at)
            at = int(order[at])
        if len(loop) > 1:
            found.append(np.array(loop))
    return found


def contradictions(
    t_s: tuple[np.ndarray, np.ndarray], command: np.ndarray, measured: np.ndarray, acting: np.ndarray | None = None
) -> list[str]:
    """Return what data says against goals and positions that are said to belong together, in one unit: sentences.

    Args:
        t_s: Stamps of commands and of measurements [s].
        command: Shape ``(N, joints)``.
        measured: Shape ``(M, joints)``.
        acting: Shape ``(N,)``: whether commands act; None: all do.
    """
    held, joined, period_s = on_grid(t_s[0], command, t_s[1], measured, acting)
    if len(held) < 50:
        return []
    found = following(held, joined, period_s).by_level()
    best, own = order(found), np.arange(measured.shape[1])
    said = [
        f"joint {i} follows the command of joint {best[i]} (r {found.r[i, best[i]]:.2f}), not its own "
        f"(r {found.r[i, i]:.2f})"
        for i in np.flatnonzero(best != own)
    ]
    kept = own[best == own]
    copies = copied(*t_s, command, measured)
    r, slope, lag = (a[kept, kept] for a in (found.r, found.slope, found.lag_s))
    for i, x, s, late in zip(kept, r, slope, lag, strict=True):
        if copies[i]:
            said.append(f"joint {i}: its commands are its measurements, so nothing can be identified from them")
        elif x < -SURE:
            said.append(f"joint {i} moves against its command (r {x:.2f}, slope {s:.3g}): one sign is wrong")
        elif x > SURE and unit_ratio(np.array([s])) not in (1.0, None):
            said.append(f"joint {i} follows its command with a slope of {s:.3g}: one is in degrees, one in radians")
        elif x > EQUAL_R and s > EQUAL_SLOPE and late < -1.5 * period_s:
            said.append(f"joint {i} moves {-1e3 * late:.0f} ms before it is told to: the clocks do not agree")
    return said


def copied(t_command: np.ndarray, t_measured: np.ndarray, command: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return which commands are the measurements themselves, of the same sample or of one beside it, ``(joints,)``.

    Args:
        t_command: Shape ``(N,)`` [s].
        t_measured: Shape ``(M,)`` [s].
        command: Shape ``(N, joints)``.
        measured: Shape ``(M, joints)``, in the unit of the commands.
    """
    newest = np.searchsorted(t_command, t_measured + 1e-6, side="right") - 1
    spread = measured.std(axis=0)
    found = np.zeros(measured.shape[1], bool)
    for shift in range(-_COPIED_ROWS, _COPIED_ROWS + 1):
        at = newest + shift
        inside = (at >= 0) & (at < len(command))
        if inside.sum() < 50:
            continue
        off = np.quantile(np.abs(measured[inside] - command[at[inside]]), 0.98, axis=0)
        found |= off <= 1e-5 * spread + 1.1e-6 * np.abs(measured).max(axis=0, initial=0.0)
        if abs(shift) <= 1:
            # One of both may have been rounded, as to the steps of an encoder.
            found |= off <= 0.51 * np.array(
                [max(_step(c), _step(m)) for c, m in zip(command.T, measured.T, strict=True)]
            )
    return found & (spread > 1e-9)


def _step(values: np.ndarray) -> float:
    """Return the step of values that were rounded, where it is small for their motion; else 0."""
    levels = np.unique(np.round(values, 9))
    if not 40 <= levels.size < 0.5 * values.size:
        return 0.0
    step = float(np.median(np.diff(levels)))
    return step if step < 0.05 * values.std() else 0.0
