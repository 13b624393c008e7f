"""Which column follows which command, how late and with which sign; and where a repeating command leaves that open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks

_MOST_ROWS = 40_000
"""More rows than this tell nothing new about who follows whom."""
_STILL = 1e-4
"""Below this spread, over that of the column that moves most, a column does not move."""
_MIRRORED = 0.2
"""What an opposite sign costs, where the same columns could also be in another order."""
_LOBE = 0.7
"""A lag range belongs to a peak while its correlation is at least this share of the highest."""
_EQUAL = 1.3, 3e-3
"""A peak is as high as the highest, if its misfit is at most so many times as large, and a little more."""
_NEAR = 4.0, 2e-2
"""A positive peak comes near a negative one, if its misfit is at most so many times as large, and a little more."""
_LEVEL = 0.1, 0.5
"""A mean belongs to a command's, if it is so close to it over the spread, and so far from its opposite."""
_PROMINENT = 0.02
"""A peak stands out of the correlations around it by this."""
_COARSE = 0.25
"""Of the error of a curve through every other sample, one through all has this share at most."""
_STRAIGHT = 0.5, 0.01
"""A line is taken out that has this share of the spread, where as much of the spread is left."""
_RESTS = 0.25
"""A column rests while it moves by less than this share of the motion that a lag predicts."""


@dataclass(frozen=True)
class Following:
    """How M measured columns follow N commands.

    Of several lags that fit equally well, as for a command that repeats, the least lag with positive sign is taken.

    Attributes:
        r: Shape ``(M, N)``: correlation; 0 where either does not move.
        lag_s: Shape ``(M, N)``: by how much the measurement is later [s].
        slope: Shape ``(M, N)``: of the measurement over the command.
        spread: Shapes ``(M,)`` and ``(N,)``: standard deviations of measurements and commands.
        mean: Shapes ``(M,)`` and ``(N,)``: their means.
        against_s: Shape ``(M, N)``: least lag at which the opposite sign fits as well [s]; NaN where none does.
        repeats_s: Shape ``(M, N)``: the next lag at which the same sign fits as well [s]; NaN where none does.
        either: Shape ``(M, N)``: whether the command may as well follow the measurement.
        period_s: Time between the rows that were compared [s].
        turn: A turn in the measurements' unit, where means may be of different turns; else 0.
    """

    r: np.ndarray
    lag_s: np.ndarray
    slope: np.ndarray
    spread: tuple[np.ndarray, np.ndarray]
    mean: tuple[np.ndarray, np.ndarray]
    against_s: np.ndarray
    repeats_s: np.ndarray
    either: np.ndarray
    period_s: float
    turn: float = 0.0

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
        apart = self._apart(mean_m[:, None] - sign * scale * mean_c)
        return (power - 2 * along + apart**2) / power + _MIRRORED * (self.r < 0)

    def _apart(self, means: np.ndarray) -> np.ndarray:
        return means - self.turn * np.round(means / self.turn) if self.turn else means

    def by_level(self, scale: float = 1.0) -> Following:
        """Return the same with signs by the means, where correlations leave them open and means do not."""
        (own, _), (mean, level) = self.spread, self.mean
        near, far = (
            np.abs(self._apart(mean[:, None] - sign * scale * level)) / (own[:, None] + 1e-30) for sign in (1.0, -1.0)
        )
        open_ = np.isfinite(self.against_s) & (self.r > 0)
        same, other = open_ & (near < _LEVEL[0]) & (far > _LEVEL[1]), open_ & (far < _LEVEL[0]) & (near > _LEVEL[1])
        return replace(
            self,
            r=np.where(other, -self.r, self.r),
            lag_s=np.where(other, self.against_s, self.lag_s),
            slope=np.where(other, -self.slope, self.slope),
            against_s=np.where(same | other, np.nan, self.against_s),
            repeats_s=np.where(other, np.nan, self.repeats_s),
        )

    def columns(self, places: np.ndarray) -> Following:
        """Return the same of some of the commands, in this order."""
        spread, mean = ((pair[0], pair[1][places]) for pair in (self.spread, self.mean))
        names = ("r", "lag_s", "slope", "against_s", "repeats_s", "either")
        return replace(self, spread=spread, mean=mean, **{name: getattr(self, name)[:, places] for name in names})


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
    steps = np.diff(t_measured)
    typical = float(np.median(steps))
    # Their mean: dates in float64 are rounded to 0.24 us, which would add up over thousands of rows.
    period = float(steps[np.abs(steps - typical) <= 0.1 * typical].mean())
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
    spread = tuple(x.std(axis=0) for x in (measured, command))
    (levelled, sense), (given, way) = (_level(x) for x in (measured, command))
    centred = [levelled, given]
    spectra = [np.fft.rfft(x, size, axis=0) for x in centred]
    most = max(1, min(int(most_s / period_s), rows // 2))
    lags = np.arange(-most, most + 1)
    shape = (measured.shape[1], command.shape[1])
    r, lag, slope = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    against, repeats, either = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, bool)
    # Only what overlaps at a lag counts: else a drift would pull lags towards 0.
    overlap = (rows - np.abs(lags))[:, None]
    sums = [_overlapping(x, lags, later) for x, later in zip(centred, (True, False), strict=True)]
    powers = [
        (_overlapping(x**2, lags, later) - total**2 / overlap).clip(0.0)
        for x, later, total in zip(centred, (True, False), sums, strict=True)
    ]
    equal = [(_EQUAL[0], _EQUAL[1] + _coarse(column)) for column in centred[1].T]
    for i in range(shape[0]):
        cross = np.fft.irfft(spectra[0][:, i, None] * np.conj(spectra[1]), size, axis=0)[lags]
        cross -= sums[0][:, i, None] * sums[1] / overlap
        scale = np.sqrt(powers[0][:, i, None] * powers[1])
        alike = np.divide(cross, scale, out=np.zeros_like(cross), where=scale > 1e-12 * scale.max(initial=1e-300))
        for j in range(shape[1]):
            pair = centred[0][:, i], centred[1][:, j]
            if sense[i] * way[j] == 0.0 and sense[i] != way[j]:
                continue  # of a joint that turns on, and of one that does not
            if peaks := _peaks(alike[:, j], *pair, equal[j], sense[i] * way[j]):
                peak, (against[i, j], repeats[i, j]), either[i, j] = _chosen(peaks, most, *pair, equal[j])
                r[i, j], lag[i, j] = alike[peak.at, j], peak.at + peak.off - most
                slope[i, j] = cross[peak.at, j] / powers[1][peak.at, j]
    mean = measured.mean(axis=0), command.mean(axis=0)
    seconds = (period_s * x for x in (lag, against, repeats))
    found = Following(r, next(seconds), slope, (spread[0], spread[1]), mean, next(seconds), next(seconds), either,
                      period_s)  # fmt: skip
    return replace(found, r=np.where(found.moved, r, 0.0))


def _level(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns about their means, and 0 for each; about a line where most of a motion is one, and its direction.

    What moves on and on is alike at every lag: what is beside the line tells lags, and the line tells the sign.
    """
    centred, t = x - x.mean(axis=0), np.linspace(-1.0, 1.0, len(x))
    line = np.outer(t, t @ centred / (t @ t))
    straight = (line.std(axis=0) > _STRAIGHT[0] * x.std(axis=0)) & (
        (centred - line).std(axis=0) > _STRAIGHT[1] * x.std(axis=0)
    )
    return centred - np.where(straight, line, 0.0), np.where(straight, np.sign(line[-1]), 0.0)


class Peak(NamedTuple):
    """A lag at which a column is most alike: its place among the lags, how far beside it, and the correlation."""

    at: int
    off: float
    r: float


def _peaks(
    alike: np.ndarray, measured: np.ndarray, command: np.ndarray, equal: tuple[float, float], sign: float
) -> list[Peak]:
    """Return the highest place of each range of lags that are alike, in order; none where an end is the highest.

    Args:
        measured: Shape ``(rows,)``.
        command: Shape ``(rows,)``.
        equal: How much higher the misfit of a peak may be that is as high as another.
        sign: The sign, where it is known; else 0.
    """
    size = np.abs(alike) if sign == 0.0 else (sign * alike).clip(0.0)
    top, last, rows = size.max(initial=0.0), len(alike) - 1, len(measured)
    if top == 0.0:
        return []
    kind = np.where(size >= _LOBE * top, np.sign(alike), 0.0)
    bounds = [0, *(np.flatnonzero(np.diff(kind)) + 1), len(kind)]
    humps = find_peaks(size, height=_LOBE * top, prominence=_PROMINENT)[0]
    highest = sorted({int(a + size[a:b].argmax()) for a, b in pairwise(bounds) if kind[a]} | set(humps.tolist()))
    inside = [k for k in highest if 0 < k < last]
    # The highest of a range's ends is no peak: what is alike there is alike by its drift.
    ends = max((float(size[k]) for k in highest if k in (0, last)), default=0.0)
    if not inside or not _as_high(max(float(size[k]) for k in inside), ends, equal):
        return []
    # Peaks compare on the same rows of the measurement: a transient at the beginning counts for all or for none.
    most = last // 2
    begin, end = max(max(inside) - most + 2, 0), rows - max(most - min(inside) + 2, 0)
    if len(inside) == 1 or end - begin < rows // 4:
        return [Peak(k, *_between(alike[k - 1 : k + 2])) for k in inside]
    # Between samples the command is a smooth curve: at ten samples a wave, half a sample is more than noise.
    curve = CubicSpline(np.arange(rows), command)
    return [_peak(k, alike[k - 1 : k + 2], k - most, measured[begin:end], curve, begin) for k in inside]


def _peak(at: int, three: np.ndarray, lag: int, measured: np.ndarray, curve: CubicSpline, begin: int) -> Peak:
    """Return the peak beside a lag, with the correlation of some rows of the measurement, which start at ``begin``."""
    rows, off = np.arange(begin, begin + len(measured)) - lag, _between(three)[0]

    def alike(beside: float) -> float:
        return _correlation(measured, curve(rows - beside))

    beside, _ = _between(np.array([alike(off + step) for step in (-0.25, 0.0, 0.25)]))
    off = float(np.clip(off + 0.25 * beside, -0.6, 0.6))
    return Peak(at, off, alike(off))


def _chosen(
    peaks: list[Peak], most: int, measured: np.ndarray, command: np.ndarray, equal: tuple[float, float]
) -> tuple[Peak, list[float], bool]:
    """Return which peak is taken, lags of the other and of the same sign [rows] or NaN, and whether either leads."""
    best = max(abs(p.r) for p in peaks)
    pool = [p for p in peaks if _as_high(abs(p.r), best, equal)]
    late = {p: p.at + p.off - most for p in peaks}
    # One row is left for the error of a lag: nothing moves before its command.
    ahead = [p for p in pool if late[p] >= -1.0]
    either = len(ahead) < len(pool) and any(late[p] > 0 for p in ahead)
    same, other = (sorted((p for p in ahead if p.r * sign > 0), key=late.__getitem__) for sign in (1, -1))
    if same and other and late[same[0]] < late[other[0]] and _rests(late[same[0]], late[other[0]], measured, command):
        del same[0]
    if not same and other:
        # A sign is called reversed only where no positive peak comes near, ahead or, closer to 0, behind.
        near = [p for p in peaks if p.r > 0 and _as_high(p.r, best, _NEAR)]
        same = [p for p in near if late[p] >= -1.0 or (p in pool and -late[p] < late[other[0]])][-1:]
        if not same:
            return other[0], [np.nan, late[other[1]] if other[1:] else np.nan], either
        return same[0], [late[other[0]], np.nan], either
    if not same:
        # The least lag of those that are too early: the sign of the closest.
        return min(pool, key=lambda p: (p.r < 0, abs(late[p]))), [np.nan, np.nan], either
    return same[0], [late[other[0]] if other else np.nan, late[same[1]] if same[1:] else np.nan], either


def _rests(early: float, late: float, measured: np.ndarray, command: np.ndarray) -> bool:
    """Return whether a column rests at the beginning where the earlier of two lags has it move [rows]."""
    moves = np.abs(command - command[0]) > 0.1 * command.std()
    begin, stop = max(int(np.ceil(early)), 0), int(moves.argmax()) + int(late)
    if not moves.any() or stop - begin < 4 or stop > len(measured):
        return False
    predicted = np.ptp(command[: stop - begin]) * measured.std() / command.std()
    return bool(predicted > 0.5 * measured.std() and np.ptp(measured[:stop]) < _RESTS * predicted)


def _coarse(command: np.ndarray) -> float:
    """Return the misfit to expect of a curve through samples, by how well every other one tells those between."""
    between = CubicSpline(np.arange(0, len(command), 2), command[::2])(np.arange(1, len(command) - 1, 2))
    return float(_COARSE * np.mean((between - command[1:-1:2]) ** 2) / max(command.var(), 1e-300))


def _as_high(r: float, best: float, factor: tuple[float, float]) -> bool:
    return 1 - r**2 <= factor[0] * max(1 - best**2, 0.0) + factor[1]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / np.sqrt(max((a @ a) * (b @ b), 1e-300)))


def _overlapping(x: np.ndarray, lags: np.ndarray, later: bool) -> np.ndarray:
    """Return sums ``(lags, columns)`` of the rows that overlap at each lag; ``later``: of the signal that follows."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    shift = lags if later else -lags
    return total[np.where(shift < 0, len(x) + shift, len(x))] - total[np.maximum(shift, 0)]


def _between(three: np.ndarray) -> tuple[float, float]:
    """Return where between samples a peak lies, in (-1/2, 1/2), and its height, by the cosine through three samples."""
    before, top, after = (float(x) for x in three)
    # One wave is exact for a single tone, at any rate; for a wide peak it is the parabola.
    turn = np.arccos(np.clip((before + after) / (2 * top), -1.0, 1.0)) if top else 0.0
    if turn < 1e-6 or turn > 2.0:
        return 0.0, top
    side = (after - before) / (2 * np.sin(turn))
    off = float(np.arctan2(np.sign(top) * side, abs(top)) / turn)
    if abs(off) > 0.5:
        return float(np.clip(off, -0.5, 0.5)), top
    return off, float(np.sign(top) * min(np.hypot(top, side), 1.0))
