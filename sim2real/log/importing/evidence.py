"""Evidence in the numbers of a recording: order of the commands, units, encoder steps, contradictions, copies."""

from itertools import combinations, product

import numpy as np

from sim2real.later import Later
from sim2real.log.importing.command_response import Following, following, on_grid

DEGREES = 180.0 / np.pi
SURE = 0.6
"""A column follows another from this correlation on."""
EQUAL_R, EQUAL_SLOPE = 0.95, 0.9
"""A column equals another, apart from a lag, if correlation and slope in one unit are above these."""
optimize = Later("scipy.optimize")
_MAX_DISTANCE = 10.0
"""Distance between a column that moves and one that does not."""
_COPIED_S, _FEW_ROWS = 1.0, 200
"""A command is compared with measurements up to this time before and after it [s], first at this number of samples."""


def order(relation: Following, scale: float = 1.0) -> np.ndarray:
    """Return the command of each measured column, ``(M,)``, with the least sum of distances.

    Columns that fit equally well in the given order keep it, as similar commands can be exchanged without effect.
    """
    # Pair columns that move with commands that move; columns that rest give no evidence.
    rests = np.equal.outer(*(~relation.moved.any(axis=axis) for axis in (1, 0)))
    distance = np.where(relation.moved, relation.by_level(scale).distance(scale), np.where(rests, 1.0, _MAX_DISTANCE))
    diagonal = np.diag(distance)
    # Ignore a tenth of the distance: similar motions can differ by more than noise.
    best = optimize.linear_sum_assignment(distance - 0.1 * np.diag(diagonal) - 1e-6 * np.eye(len(diagonal)))[1]
    selected = np.arange(len(diagonal))
    # Exchange commands in a loop only if that halves the distance at least.
    for loop in _loops(best):
        gain = diagonal[loop].sum() - distance[loop, best[loop]].sum()
        if gain > 0.5 * diagonal[loop].sum() and gain > 0.02 * len(loop):
            selected[loop] = best[loop]
    return selected


def open_pairs(relation: Following, scale: float = 1.0) -> list[tuple[int, int]]:
    """Return pairs of columns whose commands fit equally well when exchanged, although the import would differ.

    Args:
        relation: Relation to as many commands as measurements, in the selected order.
    """
    relation = relation.by_level(scale)
    distance, lag = relation.distance(scale), relation.lag_s
    moved, selected = relation.moved.all(axis=1), np.arange(len(lag))
    pairs = []
    for i, k in combinations(np.flatnonzero(moved), 2):
        swapped = selected.copy()
        swapped[[i, k]] = k, i
        two, orders = np.array([i, k]), (selected, swapped)
        if np.abs(relation.r[two, swapped[two]]).min() < SURE:
            continue
        apart, misfits = (
            [sum(values[at, places[at]] for at in two) for places in orders] for values in (distance, 1 - relation.r**2)
        )
        if apart[1] > 1.5 * apart[0] + 0.02 or misfits[1] > 1.5 * misfits[0] + 0.01:
            continue
        # An order that changes neither signs nor lags is the same import.
        signs, lags = ([values[two, places[two]] for places in orders] for values in (np.sign(relation.r), lag))
        if (signs[0] == signs[1]).all() and np.abs(lags[1] - lags[0]).max() <= 1.5 * relation.period_s:
            continue
        # Joints share the delay of their robot, so an order with more different lags is wrong.
        all_lags = [lag[moved, places[moved]] for places in orders]
        off = [np.abs(x - np.median(x)).max() for x in all_lags]
        if off[1] < 2.0 * off[0] + 3.0 * relation.period_s:
            pairs.append((int(i), int(k)))
    return pairs


def unit_ratio(slopes: np.ndarray) -> float | None:
    """Return the ratio of two signals' units, radians or degrees, from their slopes; None if no ratio fits.

    Args:
        slopes: Slopes of measurements over their commands, ``(N,)``, of either sign.
    """
    if not slopes.size:
        return None
    typical = float(np.median(np.abs(slopes)))
    # A weak servo stays far behind its goal, but no servo goes far beyond it.
    close = [k for k in (1.0, DEGREES, 1 / DEGREES) if 0.15 < typical / k < 4.0]
    return close[0] if close else None


def turn(values: np.ndarray) -> tuple[str, int] | None:
    """Return unit and counts per turn of the encoder whose steps are in the positions; None without such steps.

    Args:
        values: Positions, ``(N,)``.
    """
    levels = np.unique(np.round(values, 9))
    if not 5 <= levels.size < 0.8 * values.size + 5:
        return None
    # All steps must be multiples of the smallest usual step.
    steps = np.diff(levels)
    step = float(np.median(steps[steps > 1e-7])) if (steps > 1e-7).any() else 0.0
    if not step or np.mean(np.abs(steps / step - np.round(steps / step)) > 0.05) > 0.1:
        return None
    for unit, full_turn in (("rad", 2 * np.pi), ("deg", 360.0)):
        counts = full_turn / step
        counts_per_turn = [
            n for n in (*(1 << b for b in range(8, 24)), 1000, 2000, 4000, 10_000) if abs(counts / n - 1) < 2e-3
        ]
        if counts_per_turn:
            return unit, counts_per_turn[0]
    return None


def _loops(order: np.ndarray) -> list[np.ndarray]:
    """Return the loops of a permutation that are longer than one."""
    visited: set[int] = set()
    loops = []
    for start in range(len(order)):
        loop, at = [], start
        while at not in visited:
            visited.add(at)
            loop.append(at)
            at = int(order[at])
        if len(loop) > 1:
            loops.append(np.array(loop))
    return loops


def contradictions(
    t_s: tuple[np.ndarray, np.ndarray], command: np.ndarray, measured: np.ndarray, acting: np.ndarray | None = None
) -> list[str]:
    """Return sentences on contradictions between goals and positions that a mapping assigns to each other, in one unit.

    Args:
        t_s: Stamps of commands and of measurements [s].
        command: Shape ``(N, joints)``.
        measured: Shape ``(M, joints)``.
        acting: Shape ``(N,)``: whether commands act; None: all do.
    """
    held, joined, period_s = on_grid(t_s[0], command, t_s[1], measured, acting)
    if len(held) < 50:
        return []
    relation = following(held, joined, period_s).by_level()
    best, in_order = order(relation), np.arange(measured.shape[1])
    # Report columns that follow another command than their own.
    notes = [
        f"joint {i} follows the command of joint {best[i]} (r {relation.r[i, best[i]]:.2f}), not its own "
        f"(r {relation.r[i, i]:.2f})"
        for i in np.flatnonzero(best != in_order)
    ]
    right = in_order[best == in_order]
    # Check the others for copies, signs, units and lags.
    copies = copied(*t_s, command, measured)
    r, slope, lag = (a[right, right] for a in (relation.r, relation.slope, relation.lag_s))
    for i, x, s, late in zip(right, r, slope, lag, strict=True):
        if copies[i]:
            notes.append(
                f"joint {i}: its commands are copies of its measurements, so they hold no information on the drive"
            )
        elif x < -SURE:
            notes.append(f"joint {i} moves against its command (r {x:.2f}, slope {s:.3g}): one sign is wrong")
        elif x > SURE and unit_ratio(np.array([s])) not in (1.0, None):
            notes.append(f"joint {i} follows its command with a slope of {s:.3g}: one is in degrees, one in radians")
        elif x > EQUAL_R and s > EQUAL_SLOPE and late < -1.5 * period_s:
            notes.append(f"joint {i} moves {-1e3 * late:.0f} ms before its command: the clocks do not agree")
    return notes


def copied(t_command: np.ndarray, t_measured: np.ndarray, command: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return whether commands are copies of measurements up to 1 s before or after them, ``(joints,)``.

    Measurements that equal commands apart from a lag lack the response of a motor.


    Args:
        t_command: Shape ``(N,)`` [s].
        t_measured: Shape ``(M,)`` [s].
        command: Shape ``(N, joints)``.
        measured: Shape ``(M, joints)``, in the unit of the commands.
    """
    newest = np.searchsorted(t_command, t_measured + 1e-6, side="right") - 1
    spread = measured.std(axis=0)
    exact = 1e-5 * spread + 1.1e-6 * np.abs(measured).max(axis=0, initial=0.0)
    # Allow rounding of one of both, as to the steps of an encoder, for the same and the neighbouring sample.
    rounded = 0.51 * np.array([max(_step(c), _step(m)) for c, m in zip(command.T, measured.T, strict=True)])
    # Compare only rows in motion: resting columns are equal at every lag.
    moves = np.abs(np.diff(measured, axis=0, prepend=measured[:1]))
    moves = moves > 0.01 * moves.max(axis=0, initial=0.0)
    rows = [np.flatnonzero(m) for m in moves.T]
    most = round(_COPIED_S / max(float(np.median(np.diff(t_command))), 1e-4)) if len(command) > 2 else 0
    copies = np.zeros(measured.shape[1], bool)
    for i, shift in product(range(len(rows)), range(-most, most + 1)):
        limit = max(exact[i], rounded[i]) if abs(shift) <= 1 else exact[i]
        # Look at a few rows first, and at all rows if the few are equal.
        for some, share in ((rows[i][:: max(len(rows[i]) // _FEW_ROWS, 1)], 0.9), (rows[i], 0.98)):
            at = newest[some] + shift
            inside = (at >= 0) & (at < len(command))
            off = np.abs(measured[some[inside], i] - command[at[inside], i])
            if inside.sum() < 20 or np.mean(off <= limit) < share:
                break
        else:
            copies[i] = True
    return copies & (spread > 1e-9)


def _step(values: np.ndarray) -> float:
    """Return the step of rounded values if it is small relative to their motion; else 0."""
    levels = np.unique(np.round(values, 9))
    if not 40 <= levels.size < 0.5 * values.size:
        return 0.0
    step = float(np.median(np.diff(levels)))
    return step if step < 0.05 * values.std() else 0.0
