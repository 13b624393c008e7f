"""Coverage of a recording: the ranges of its signals, the time in motion, and the frequencies that drive it."""

import math
from dataclasses import dataclass

import numpy as np

BINS = 10
_GAP = 2.5
"""Pauses longer than this many periods are gaps."""
_THIN = 0.1
"""A bin is empty below this share of the samples that an even spread would give it."""
_STILL = 0.05
"""A joint stands still below this share of its highest speed, or below three deviations of a measured speed."""

_NOISE_ORDER = 6
"""Differences of this order keep 0.2 % of a motion at a tenth of the sampling rate, and all white noise."""
_WINDOW_S = 0.03


@dataclass(frozen=True)
class Sampling:
    """Regularity of samples.

    Attributes:
        duration_s: From the first to the last sample [s].
        rate_hz: Median rate [Hz].
        gaps: Number of pauses longer than two and a half periods.
        longest_gap_s: 0 without gaps [s].
    """

    samples: int
    duration_s: float
    rate_hz: float
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True)
class Histogram:
    """Distribution of a signal's values.

    Attributes:
        shares: Shape ``(10,)``: share of the samples in each tenth of the range.
    """

    low: float
    high: float
    shares: tuple[float, ...]

    @property
    def covered(self) -> float:
        """Share of the tenths that hold at least 1 % of the samples."""
        return sum(s >= _THIN / BINS for s in self.shares) / len(self.shares)

    @property
    def moves(self) -> bool:
        """Whether there are different values."""
        return self.high > self.low


@dataclass(frozen=True)
class Motion:
    """Motion of a joint.

    Attributes:
        moving: Share of the time in motion.
        forward: Share of that time in which the position increases.
        reversals: Number of changes of direction.
    """

    moving: float
    forward: float
    reversals: int


@dataclass(frozen=True)
class Band:
    """Band of a signal's power: 95 % lie between ``low_hz`` and ``high_hz``, 2.5 % on either side."""

    low_hz: float
    high_hz: float


def sampling(t_s: np.ndarray) -> Sampling:
    """Return the regularity of times ``(N,)`` [s]."""
    steps = np.diff(np.asarray(t_s, np.float64))
    if not steps.size:
        return Sampling(len(t_s), 0.0, 0.0, 0, 0.0)
    period = float(np.median(steps))
    gaps = steps[steps > _GAP * period]
    rate_hz = 1.0 / period if period > 0 else 0.0
    return Sampling(len(t_s), float(t_s[-1] - t_s[0]), rate_hz, int(gaps.size), float(gaps.max(initial=0.0)))


def spread(values: np.ndarray) -> Histogram:
    """Return the distribution of values ``(N,)`` over their range."""
    values = np.asarray(values, np.float64)
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return Histogram(low, high, (1.0, *([0.0] * (BINS - 1))))
    counts, _ = np.histogram(values, BINS, (low, high))
    return Histogram(low, high, tuple((counts / values.size).tolist()))


def speed(t_s: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the rate of a sampled position ``(N,)``, by differences; 0 with fewer than three samples."""
    if len(position) < 3:
        return np.zeros(len(position))
    times = np.asarray(t_s, np.float64)
    steps = np.maximum(np.diff(times), 1e-9)  # equal stamps must not make it infinite
    return np.gradient(np.asarray(position, np.float64), times[0] + np.concatenate([[0.0], np.cumsum(steps)]))


def motion(velocity: np.ndarray, sigma: float = 0.0) -> Motion:
    """Return the motion of a joint with velocities ``(N,)`` and their deviation."""
    velocity = np.asarray(velocity, np.float64)
    # Compare with the 99 % quantile: a rare spike must not make the other speeds count as standing still.
    still = max(_STILL * float(np.quantile(np.abs(velocity), 0.99)), 3.0 * sigma)
    fast = np.abs(velocity) > still
    if not fast.any():
        return Motion(0.0, 0.0, 0)
    signs = np.sign(velocity[fast])
    return Motion(float(fast.mean()), float((signs > 0).mean()), int((np.diff(signs) != 0).sum()))


def motion_of(t_s: np.ndarray, position: np.ndarray) -> Motion:
    """Return the motion of a joint with positions ``(N,)`` at times ``(N,)`` [s]; noise and quantisation do not count.

    Speeds are those of positions averaged over 30 ms, so that the noise of fast samples does not hide slow motion.
    """
    t_s, position = np.asarray(t_s, np.float64), np.asarray(position, np.float64)
    good = np.isfinite(position) & np.isfinite(t_s)
    t_s, position = t_s[good], position[good]
    if len(position) < 3 * _NOISE_ORDER:
        return motion(speed(t_s, position))
    period_s = max(float(np.median(np.diff(t_s))), 1e-9)
    # Average over 30 ms.
    width = min(max(1, round(_WINDOW_S / period_s)), len(position) // 3)
    mean = np.full(width, 1.0 / width)
    deviation = _noise(position)
    times, smooth = (np.convolve(values, mean, "valid") for values in (t_s - t_s[0], position))
    # Compare the range of the averages with the noise and the steps of the readings.
    least = max(1.5 * float(np.diff(np.unique(position)).min(initial=np.inf)), 8.0 * deviation / np.sqrt(width))
    if not np.ptp(np.quantile(smooth, [0.005, 0.995])) > least:
        return Motion(0.0, 0.0, 0)
    return motion(speed(times, smooth), deviation / (width * period_s))


def _noise(values: np.ndarray) -> float:
    """Return the deviation of white noise in values ``(N,)``, by high differences without the largest 2 %: leaps."""
    squares = np.sort(np.diff(values, _NOISE_ORDER) ** 2)
    return float(np.sqrt(squares[: math.ceil(0.98 * squares.size)].mean() / math.comb(2 * _NOISE_ORDER, _NOISE_ORDER)))


def band(t_s: np.ndarray, values: np.ndarray, share: float = 0.95) -> Band | None:
    """Return the band of a signal's power without its mean; None for a constant signal.

    Args:
        t_s: Shape ``(N,)``: start of each value, which holds until the next [s].
        values: Shape ``(N,)``.
        share: Share of the power inside; equal parts of the rest lie below and above.
    """
    t_s, values = np.asarray(t_s, np.float64), np.asarray(values, np.float64)
    if len(values) < 8 or np.ptp(values) == 0.0 or t_s[-1] <= t_s[0]:
        return None
    period = float(np.median(np.diff(t_s)))
    if period <= 0.0:
        return None
    # Sample the held values evenly, and take their spectrum.
    even = np.arange(t_s[0], t_s[-1] + 0.5 * period, period)
    held = values[np.clip(np.searchsorted(t_s, even + 1e-9, side="right") - 1, 0, None)]
    held = (held - held.mean()) * np.hanning(len(held))
    power = np.abs(np.fft.rfft(held)) ** 2
    hz = np.fft.rfftfreq(len(held), period)
    below = np.cumsum(power[1:])
    if not below.size or below[-1] <= 0.0:
        return None
    low, high = np.searchsorted(below / below[-1], [(1 - share) / 2, (1 + share) / 2])
    return Band(float(hz[1:][low]), float(hz[1:][min(high, len(hz) - 2)]))
