"""What the numbers of a recording say by themselves: what follows what, how late, with which sign, in which unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

DEGREES = 180.0 / np.pi
_MOST_ROWS = 40_000
"""More rows than this tell nothing new about who follows whom."""
SURE = 0.6
"""Correlation from which a column is said to follow another."""
_STILL = 1e-4
"""Below this spread, over that of the column that moves most, a column does not move."""
_MIRRORED = 0.2
"""What an opposite sign costs, where the same columns could also be in another order."""


@dataclass(frozen=True)
class Following:
    """How M measured columns follow N commands, each at the lag at which they are most alike.

    Attributes:
        r: Shape ``(M, N)``: correlation; 0 where either does not move.
        lag_s: Shape ``(M, N)``: by how much the measurement is later [s].
        slope: Shape ``(M, N)``: of the measurement over the command.
        spread: Shapes ``(M,)`` and ``(N,)``: standard deviations of measurements and commands.
        mean: Shapes ``(M,)`` and ``(N,)``: their means.
    """

    r: np.ndarray
    lag_s: np.ndarray
    slope: np.ndarray
    spread: tuple[np.ndarray, np.ndarray]
    mean: tuple[np.ndarray, np.ndarray]

    @property
    def moved(self) -> np.ndarray:
        """Whether anything can be told of a pair, ``(M, N)``: both its columns move."""
        return np.outer(*(s > _STILL * s.max(initial=1e-12) for s in self.spread))

    def distance(self, scale: float = 1.0) -> np.ndarray:
        """Return how far measurements are from commands times ``scale``, of either sign, ``(M, N)``.

        0 for columns that are equal but for a lag, about 1 for unrelated ones about the same mean. Opposite signs cost
        a little: of two mirrored joints, each is rather the other one's than its own upside down.
        """
        (m, c), (mean_m, mean_c) = self.spread, self.mean
        power = m[:, None] ** 2 + (scale * c) ** 2 + 1e-30
        along = scale * np.abs(self.r) * np.outer(m, c)
        sign = np.where(self.r < 0, -1.0, 1.0)
        return (power - 2 * along + (mean_m[:, None] - sign * scale * mean_c) ** 2) / power + _MIRRORED * (self.r < 0)


def on_grid(
    t_command: np.ndarray,
    command: np.ndarray,
    t_measured: np.ndarray,
    measured: np.ndarray,
    acting: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return commands and measurements on one grid of time, and its period [s]: commands hold, measurements are joined.

    While commands do not act, as with torque off, both are put to their means: that says nothing of who follows whom.

    Args:
        t_command: Shape ``(N,)`` [s].
        command: Shape ``(N, columns)``.
        t_measured: Shape ``(M,)`` [s].
        measured: Shape ``(M, columns)``.
        acting: Shape ``(N,)``: whether commands act; None: all do.
    """
    period = float(np.median(np.diff(t_measured)))
    begin, end = max(t_command[0], t_measured[0]), min(t_command[-1], t_measured[-1])
    t = begin + period * np.arange(min(max(int((end - begin) / period), 0), _MOST_ROWS))
    newest = np.clip(np.searchsorted(t_command, t + 1e-3 * period, side="right") - 1, 0, len(command) - 1)
    held, joined = command[newest], np.stack([np.interp(t, t_measured, column) for column in measured.T], axis=1)
    if acting is not None and not (on := acting[newest]).all() and on.any():
        held, joined = (np.where(on[:, None], x, x[on].mean(axis=0)) for x in (held, joined))
    return held, joined, period


def following(command: np.ndarray, measured: np.ndarray, period_s: float, most_s: float = 1.0) -> Following:
    """Return how measured columns follow commands.

    Args:
        command: Shape ``(rows, N)``, finite.
        measured: Shape ``(rows, M)``, finite.
        period_s: Time between rows [s].
        most_s: Largest lag that is looked for, either way [s].
    """
    rows = len(measured)
    size = 1 << (2 * rows - 1).bit_length()
    centred = [x - x.mean(axis=0) for x in (measured, command)]
    spread = tuple(x.std(axis=0) for x in centred)
    spectra = [np.fft.rfft(x, size, axis=0) for x in centred]
    most = max(1, min(int(most_s / period_s), rows // 2))
    lags = np.arange(-most, most + 1)
    shape = (measured.shape[1], command.shape[1])
    r, lag, slope = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    # Only what overlaps at a lag counts: else a drift would pull lags towards 0.
    overlap = (rows - np.abs(lags))[:, None]
    sums = [_overlapping(x, lags, later) for x, later in zip(centred, (True, False), strict=True)]
    powers = [
        (_overlapping(x**2, lags, later) - total**2 / overlap).clip(0.0)
        for x, later, total in zip(centred, (True, False), sums, strict=True)
    ]
    for i in range(shape[0]):
        cross = np.fft.irfft(spectra[0][:, i, None] * np.conj(spectra[1]), size, axis=0)[lags]
        cross -= sums[0][:, i, None] * sums[1] / overlap
        scale = np.sqrt(powers[0][:, i, None] * powers[1])
        alike = np.divide(cross, scale, out=np.zeros_like(cross), where=scale > 1e-12 * scale.max(initial=1e-300))
        best = np.argmax(np.abs(alike), axis=0)
        at = best, np.arange(shape[1])
        r[i] = alike[at]
        slope[i] = np.divide(cross[at], powers[1][at], out=np.zeros(shape[1]), where=powers[1][at] > 0)
        # The highest of a range's ends is no peak: what is alike there is alike by its drift.
        r[i, (best == 0) | (best == 2 * most)] = 0.0
        lag[i] = period_s * (lags[best] + _between(np.abs(alike), best))
    found = Following(r, lag, slope, (spread[0], spread[1]), (measured.mean(axis=0), command.mean(axis=0)))
    return Following(np.where(found.moved, r, 0.0), lag, slope, found.spread, found.mean)


def order(found: Following, scale: float = 1.0) -> np.ndarray:
    """Return the command of each measured column, ``(M,)``, so that together they are closest.

    What is as close in the given order keeps it: commands that are alike cannot be told apart, and need not be.

    Args:
        found: Of as many commands as measurements.
        scale: From the commands' unit to the measurements'.
    """
    distance = np.where(found.moved, found.distance(scale), 1.0)
    own = np.diag(distance)
    # What moves alike may differ in anything but noise: a tenth of the distance does not count.
    best = linear_sum_assignment(distance - 0.1 * np.diag(own) - 1e-6 * np.eye(len(own)))[1]
    kept = np.arange(len(own))
    for loop in _loops(best):
        gain = own[loop].sum() - distance[loop, best[loop]].sum()
        if gain > 0.5 * own[loop].sum() and gain > 0.02 * len(loop):
            kept[loop] = best[loop]
    return kept


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


def _overlapping(x: np.ndarray, lags: np.ndarray, later: bool) -> np.ndarray:
    """Return sums ``(lags, columns)`` of the rows that overlap at each lag; ``later``: of the signal that follows."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    shift = lags if later else -lags
    return total[np.where(shift < 0, len(x) + shift, len(x))] - total[np.maximum(shift, 0)]


def _between(cross: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Return where between samples the peak of each column lies, by a parabola, in (-1/2, 1/2)."""
    at = np.arange(cross.shape[1])
    inside = np.clip(best, 1, len(cross) - 2)
    before, top, after = (cross[inside + k, at] for k in (-1, 0, 1))
    bend = before - 2 * top + after
    off = np.divide(0.5 * (before - after), bend, out=np.zeros_like(top), where=bend < 0)
    return np.where(inside == best, np.clip(off, -0.5, 0.5), 0.0)


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
    found = following(held, joined, period_s)
    best, own = order(found), np.arange(measured.shape[1])
    said = [
        f"joint {i} follows the command of joint {best[i]} (r {found.r[i, best[i]]:.2f}), not its own "
        f"(r {found.r[i, i]:.2f})"
        for i in np.flatnonzero(best != own)
    ]
    kept = own[best == own]
    r, slope, lag = (a[kept, kept] for a in (found.r, found.slope, found.lag_s))
    for i, x, s, late in zip(kept, r, slope, lag, strict=True):
        if x < -SURE:
            said.append(f"joint {i} moves against its command (r {x:.2f}, slope {s:.3g}): one sign is wrong")
        elif x > SURE and unit_ratio(np.array([s])) not in (1.0, None):
            said.append(f"joint {i} follows its command with a slope of {s:.3g}: one is in degrees, one in radians")
        elif x > SURE and late < -1.5 * period_s:
            said.append(f"joint {i} moves {-1e3 * late:.0f} ms before it is told to: the clocks do not agree")
    return said
