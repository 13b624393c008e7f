"""Lag, sign and slope of each measured column relative to each command; ambiguous for commands that repeat."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sim2real.later import Later
from sim2real.types import PyTree

interpolate = Later("scipy.interpolate")
signal = Later("scipy.signal")
_MAX_ROWS = 40_000
"""Maximum number of compared rows; more rows change no lag."""
_MIN_SPREAD = 1e-4
"""A column moves if its spread exceeds this share of the largest spread."""
_SIGN_COST = 0.2
"""Distance that an opposite sign adds: two mirrored joints are rather in another order than upside down."""
_LOBE = 0.7
"""The lags of a peak have at least this share of the highest correlation."""
_EQUAL = 1.3, 3e-3
"""A peak equals the highest one if its misfit is at most the first number times as large, plus the second."""
_NEAR = 4.0, 2e-2
"""A positive peak is near a negative one if its misfit is at most the first number times as large, plus the second."""
_LEVEL = 0.1, 0.5
"""Means decide a sign if they differ by less than the first number of spreads, and by more than the second from the
opposite."""
_PROMINENT = 0.02
"""Least prominence of a peak of the correlation."""
_SPLINE_ERROR = 0.25
"""Largest error of a curve through all samples, as a share of the error of a curve through every other sample."""
_LINE_SHARE = 0.5, 0.01
"""A line is removed if it has the first share of the spread, and the rest has the second."""
_REST_SHARE = 0.25
"""A column rests while it moves by less than this share of the motion that a lag predicts."""


@dataclass(frozen=True)
class Following:
    """The relation of M measured columns to N commands.

    If several lags fit equally well, as for a command that repeats, the least lag with positive sign is taken.

    Attributes:
        r: Shape ``(M, N)``: correlation; 0 if either does not move.
        lag_s: Shape ``(M, N)``: delay of the measurement [s].
        slope: Shape ``(M, N)``: slope of the measurement over the command.
        spread: Shapes ``(M,)`` and ``(N,)``: standard deviations of measurements and commands.
        mean: Shapes ``(M,)`` and ``(N,)``: means of measurements and commands.
        against_s: Shape ``(M, N)``: least lag at which the opposite sign fits equally well [s]; NaN without one.
        repeats_s: Shape ``(M, N)``: next lag at which the same sign fits equally well [s]; NaN without one.
        either: Shape ``(M, N)``: whether the command can also follow the measurement.
        period_s: Time between the compared rows [s].
        turn: A turn in the measurements' unit if means can be of different turns; else 0.
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
        """Whether both columns of a pair move, ``(M, N)``."""
        return np.outer(*(s > _MIN_SPREAD * s.max(initial=1e-12) for s in self.spread))

    def distance(self, scale: float = 1.0) -> np.ndarray:
        """Return the distance of measurements from commands times ``scale``, of either sign, ``(M, N)``.

        0 for columns that differ only by a lag, about 1 for unrelated columns with the same mean; an opposite sign adds
        ``_SIGN_COST``.
        """
        (m, c), (mean_m, mean_c) = self.spread, self.mean
        power = m[:, None] ** 2 + (scale * c) ** 2 + 1e-30
        along = scale * np.abs(self.r) * np.outer(m, c)
        sign = np.where(self.r < 0, -1.0, 1.0)
        apart = self._apart(mean_m[:, None] - sign * scale * mean_c)
        return (power - 2 * along + apart**2) / power + _SIGN_COST * (self.r < 0)

    def _apart(self, means: np.ndarray) -> np.ndarray:
        return means - self.turn * np.round(means / self.turn) if self.turn else means

    def by_level(self, scale: float = 1.0) -> Following:
        """Return the relation with signs from the means if the correlations do not decide them."""
        (spread, _), (mean, level) = self.spread, self.mean
        # Compare the means with the command's, and with its opposite.
        near, far = (
            np.abs(self._apart(mean[:, None] - sign * scale * level)) / (spread[:, None] + 1e-30)
            for sign in (1.0, -1.0)
        )
        undecided = np.isfinite(self.against_s) & (self.r > 0)
        same, other = (
            undecided & (near < _LEVEL[0]) & (far > _LEVEL[1]),
            undecided & (far < _LEVEL[0]) & (near > _LEVEL[1]),
        )
        return replace(
            self,
            r=np.where(other, -self.r, self.r),
            lag_s=np.where(other, self.against_s, self.lag_s),
            slope=np.where(other, -self.slope, self.slope),
            against_s=np.where(same | other, np.nan, self.against_s),
            repeats_s=np.where(other, np.nan, self.repeats_s),
        )

    def columns(self, places: np.ndarray) -> Following:
        """Return the relation to some of the commands, in this order."""
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
    """Return commands and measurements on one time grid, and its period [s].

    Commands are held, measurements are interpolated. While commands do not act (torque off), both get their means.

    Args:
        t_command: Shape ``(N,)`` [s].
        command: Shape ``(N, columns)``.
        t_measured: Shape ``(M,)`` [s].
        measured: Shape ``(M, columns)``.
        acting: Shape ``(N,)``: whether commands act; default: all act.
    """
    steps = np.diff(t_measured)
    typical = float(np.median(steps))
    # Use the mean step: dates in float64 are rounded to 0.24 us, an error that adds up over thousands of rows.
    period = float(steps[np.abs(steps - typical) <= 0.1 * typical].mean())
    begin, end = max(t_command[0], t_measured[0]), min(t_command[-1], t_measured[-1])
    t = begin + period * np.arange(min(max(int((end - begin) / period), 0), _MAX_ROWS))
    newest = np.clip(np.searchsorted(t_command, t + 1e-3 * period, side="right") - 1, 0, len(command) - 1)
    held, joined = command[newest], np.stack([np.interp(t, t_measured, column) for column in measured.T], axis=1)
    if acting is not None and not (on := acting[newest]).all() and on.any():
        held, joined = (np.where(on[:, None], x, x[on].mean(axis=0)) for x in (held, joined))
    return held, joined, period


def following(command: np.ndarray, measured: np.ndarray, period_s: float, most_s: float = 1.0) -> Following:
    """Return the relation of measured columns to commands.

    Args:
        command: Shape ``(rows, N)``, finite.
        measured: Shape ``(rows, M)``, finite.
        period_s: Time between rows [s].
        most_s: Largest lag in either direction [s].
    """
    # Centre the columns, or remove their lines, and transform them for the correlation at all lags.
    rows = len(measured)
    size = 1 << (2 * rows - 1).bit_length()
    spread = tuple(x.std(axis=0) for x in (measured, command))
    (levelled, sense), (levelled_command, way) = (_level(x) for x in (measured, command))
    centred = [levelled, levelled_command]
    spectra = [np.fft.rfft(x, size, axis=0) for x in centred]
    most = max(1, min(int(most_s / period_s), rows // 2))
    lags = np.arange(-most, most + 1)
    shape = (measured.shape[1], command.shape[1])
    r, lag, slope = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    against, repeats, either = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, bool)
    # Correlate only the rows that overlap at a lag, as a drift would pull lags towards 0.
    overlap = (rows - np.abs(lags))[:, None]
    sums = [_overlapping(x, lags, later) for x, later in zip(centred, (True, False), strict=True)]
    powers = [
        (_overlapping(x**2, lags, later) - total**2 / overlap).clip(0.0)
        for x, later, total in zip(centred, (True, False), sums, strict=True)
    ]
    # Select the best peak of each pair.
    equal = [(_EQUAL[0], _EQUAL[1] + _coarse(column)) for column in centred[1].T]
    for i in range(shape[0]):
        cross = np.fft.irfft(spectra[0][:, i, None] * np.conj(spectra[1]), size, axis=0)[lags]
        cross -= sums[0][:, i, None] * sums[1] / overlap
        scale = np.sqrt(powers[0][:, i, None] * powers[1])
        alike = np.divide(cross, scale, out=np.zeros_like(cross), where=scale > 1e-12 * scale.max(initial=1e-300))
        for j in range(shape[1]):
            pair = centred[0][:, i], centred[1][:, j]
            if sense[i] * way[j] == 0.0 and sense[i] != way[j]:
                continue  # one of both moves along a line, and the other does not
            if peaks := _peaks(alike[:, j], *pair, equal[j], sense[i] * way[j]):
                peak, (against[i, j], repeats[i, j]), either[i, j] = _chosen(peaks, most, *pair, equal[j])
                r[i, j], lag[i, j] = alike[peak.at, j], peak.at + peak.off - most
                slope[i, j] = cross[peak.at, j] / powers[1][peak.at, j]
    mean = measured.mean(axis=0), command.mean(axis=0)
    seconds = (period_s * x for x in (lag, against, repeats))
    relation = Following(r, next(seconds), slope, (spread[0], spread[1]), mean, next(seconds), next(seconds), either,
                      period_s)  # fmt: skip
    return replace(relation, r=np.where(relation.moved, r, 0.0))


def _level(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centred columns, and 0 for each; without a line that is most of the motion, and the line's direction.

    A line fits at every lag: the rest of the motion determines the lag, and the line determines the sign.
    """
    centred, t = x - x.mean(axis=0), np.linspace(-1.0, 1.0, len(x))
    line = np.outer(t, t @ centred / (t @ t))
    straight = (line.std(axis=0) > _LINE_SHARE[0] * x.std(axis=0)) & (
        (centred - line).std(axis=0) > _LINE_SHARE[1] * x.std(axis=0)
    )
    return centred - np.where(straight, line, 0.0), np.where(straight, np.sign(line[-1]), 0.0)


class Peak(NamedTuple):
    """A peak of the correlation: its place among the lags, the offset from that place, and the correlation."""

    at: int
    off: float
    r: float


def _peaks(
    alike: np.ndarray, measured: np.ndarray, command: np.ndarray, equal: tuple[float, float], sign: float
) -> list[Peak]:
    """Return the highest place of each range of correlated lags, in order; empty if an end is the highest.

    Args:
        measured: Shape ``(rows,)``.
        command: Shape ``(rows,)``.
        equal: Limits of the misfit of a peak that equals another, as ``_EQUAL``.
        sign: The sign; 0 if it is open.
    """
    size = np.abs(alike) if sign == 0.0 else (sign * alike).clip(0.0)
    top, last, rows = size.max(initial=0.0), len(alike) - 1, len(measured)
    if top == 0.0:
        return []
    kind = np.where(size >= _LOBE * top, np.sign(alike), 0.0)
    bounds = [0, *(np.flatnonzero(np.diff(kind)) + 1), len(kind)]
    humps = signal.find_peaks(size, height=_LOBE * top, prominence=_PROMINENT)[0]
    highest = sorted({int(a + size[a:b].argmax()) for a, b in pairwise(bounds) if kind[a]} | set(humps.tolist()))
    inside = [k for k in highest if 0 < k < last]
    # A range that is highest at its end is no peak: a drift causes this correlation.
    ends = max((float(size[k]) for k in highest if k in (0, last)), default=0.0)
    if not inside or not _as_high(max(float(size[k]) for k in inside), ends, equal):
        return []
    # Compare peaks on the same rows of the measurement, so that a transient at the beginning affects all or none.
    most = last // 2
    begin, end = max(max(inside) - most + 2, 0), rows - max(most - min(inside) + 2, 0)
    if len(inside) == 1 or end - begin < rows // 4:
        return [Peak(k, *_between(alike[k - 1 : k + 2])) for k in inside]
    # Interpolate the command by a smooth curve: at ten samples a wave, half a sample is more than the noise.
    curve = interpolate.CubicSpline(np.arange(rows), command)
    return [_peak(k, alike[k - 1 : k + 2], k - most, measured[begin:end], curve, begin) for k in inside]


def _peak(at: int, three: np.ndarray, lag: int, measured: np.ndarray, curve: PyTree, begin: int) -> Peak:
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
    """Return the selected peak, lags of the other and of the same sign [rows] or NaN, and whether either can lead."""
    best = max(abs(p.r) for p in peaks)
    pool = [p for p in peaks if _as_high(abs(p.r), best, equal)]
    late = {p: p.at + p.off - most for p in peaks}
    # A measurement follows its command; one row is the margin for the error of a lag.
    ahead = [p for p in pool if late[p] >= -1.0]
    either = len(ahead) < len(pool) and any(late[p] > 0 for p in ahead)
    same, other = (sorted((p for p in ahead if p.r * sign > 0), key=late.__getitem__) for sign in (1, -1))
    if same and other and late[same[0]] < late[other[0]] and _rests(late[same[0]], late[other[0]], measured, command):
        del same[0]
    if not same and other:
        # Take the opposite sign only if no positive peak is near: ahead, or behind and closer to 0.
        near = [p for p in peaks if p.r > 0 and _as_high(p.r, best, _NEAR)]
        same = [p for p in near if late[p] >= -1.0 or (p in pool and -late[p] < late[other[0]])][-1:]
        if not same:
            return other[0], [np.nan, late[other[1]] if other[1:] else np.nan], either
        return same[0], [late[other[0]], np.nan], either
    if same and other and _moves_early(late[same[0]], late[other[0]], measured, command):
        other = []
    if not same:
        # All lags are too early: take the smallest.
        return min(pool, key=lambda p: (p.r < 0, abs(late[p]))), [np.nan, np.nan], either
    return same[0], [late[other[0]] if other else np.nan, late[same[1]] if same[1:] else np.nan], either


def _rests(early: float, late: float, measured: np.ndarray, command: np.ndarray) -> bool:
    """Return whether a column rests at the beginning although the earlier of two lags [rows] predicts motion."""
    moves = np.abs(command - command[0]) > 0.1 * command.std()
    begin, stop = max(int(np.ceil(early)), 0), int(moves.argmax()) + int(late)
    if not moves.any() or stop - begin < 4 or stop > len(measured):
        return False
    predicted = np.ptp(command[: stop - begin]) * measured.std() / command.std()
    return bool(predicted > 0.5 * measured.std() and np.ptp(measured[:stop]) < _REST_SHARE * predicted)


def _moves_early(early: float, late: float, measured: np.ndarray, command: np.ndarray) -> bool:
    """Return whether a column starts from rest with its command, and moves before the later of two lags [rows].

    Half a period is between the lags. Only a start differs from the motion one period later.
    """
    period, within = round(2.0 * abs(late - early)), int(late)
    if within < 4 or period < 4 or len(measured) < 4 * period:
        return False
    spread, begin = measured.std(), measured[:within]
    # The column starts where the command starts, with either sign, and rests.
    centred = abs(measured[0] - measured.mean()), abs(command[0] - command.mean()) * spread / command.std()
    few = max(3, int(0.5 * early) + 1)
    rests = np.ptp(measured[:few]) < _REST_SHARE * np.median(np.ptp(sliding_window_view(measured, few), axis=1))
    change = np.abs(measured[within:-period] - measured[within + period :])
    differs = np.abs(begin - measured[period : period + within]).max() > 3.0 * np.quantile(change, 0.99) + 0.1 * spread
    return bool(rests and differs and abs(centred[0] - centred[1]) < 0.2 * spread and np.ptp(begin) > 0.5 * spread)


def _coarse(command: np.ndarray) -> float:
    """Return the expected misfit of a curve through samples, from a curve through every other sample."""
    between = interpolate.CubicSpline(np.arange(0, len(command), 2), command[::2])(np.arange(1, len(command) - 1, 2))
    return float(_SPLINE_ERROR * np.mean((between - command[1:-1:2]) ** 2) / max(command.var(), 1e-300))


def _as_high(r: float, best: float, factor: tuple[float, float]) -> bool:
    return 1 - r**2 <= factor[0] * max(1 - best**2, 0.0) + factor[1]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / np.sqrt(max((a @ a) * (b @ b), 1e-300)))


def _overlapping(x: np.ndarray, lags: np.ndarray, later: bool) -> np.ndarray:
    """Return sums ``(lags, columns)`` of the rows that overlap at each lag; ``later`` for the signal that follows."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    shift = lags if later else -lags
    return total[np.where(shift < 0, len(x) + shift, len(x))] - total[np.maximum(shift, 0)]


def _between(three: np.ndarray) -> tuple[float, float]:
    """Return the offset of a peak in (-1/2, 1/2) samples, and its height, from the cosine through three samples."""
    before, top, after = (float(x) for x in three)
    # A cosine is exact for a single tone at any rate; for a wide peak it equals the parabola.
    turn = np.arccos(np.clip((before + after) / (2 * top), -1.0, 1.0)) if top else 0.0
    if turn < 1e-6 or turn > 2.0:
        return 0.0, top
    side = (after - before) / (2 * np.sin(turn))
    off = float(np.arctan2(np.sign(top) * side, abs(top)) / turn)
    if abs(off) > 0.5:
        return float(np.clip(off, -0.5, 0.5)), top
    return off, float(np.sign(top) * min(np.hypot(top, side), 1.0))
