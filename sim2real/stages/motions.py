"""Short command signals, of which a designed excitation is made."""

from __future__ import annotations

import numpy as np

_FADE_S = 0.25
"""Each begins and ends at rest, and comes and goes within this time [s]."""
_QUIET = 0.2
"""Share of the commands that stay at rest, where there are several: what a joint does alone is told best."""
_MOST_LINES = 12
"""As many as a multisine has."""


def motions(
    rng: np.random.Generator,
    shape: tuple[int, int],
    rate_hz: float,
    band_hz: tuple[float, float],
    limits: tuple[np.ndarray, np.ndarray],
    slew_per_s: float,
    others: np.ndarray,
) -> np.ndarray:
    """Return command signals, ``(count, samples, commands)``: sums of a few sines, or sweeps, around any middle.

    All are smooth. A step says more of an ideal robot, but on a real one nobody knows to the millisecond when it takes
    effect, and what is wrong by that stays in the motion.

    Args:
        rng: Random numbers.
        shape: How many, and the samples of each.
        rate_hz: Commands per second [Hz].
        band_hz: Lowest and highest frequency [Hz].
        limits: Lowest and highest commands, each ``(commands,)``; rest is 0.
        slew_per_s: Largest rate of change of a command [the command's unit per second].
        others: Shape ``(K, samples, commands)``: signals that take the places of the first K, within the same limits.
    """
    (low, high), (count, samples) = limits, shape
    commands = len(low)
    t = np.arange(samples) / rate_hz
    fade = np.sin(0.5 * np.pi * np.clip(np.minimum(t, t[-1] - t) / _FADE_S, 0.0, 1.0)) ** 2
    found = np.zeros((count, samples, commands))
    for one in found:
        for c in range(commands):
            quiet = commands > 1 and rng.random() < _QUIET
            wave = (_sines if rng.random() < 0.5 else _sweep)(t, band_hz, rng)
            size = np.exp(rng.uniform(np.log(0.1), 0.0)) if rng.random() < 0.5 else 1.0
            middle = rng.uniform(-1.0, 1.0) * (1.0 - size)
            played = 0.5 * (high[c] + low[c]) + 0.5 * (high[c] - low[c]) * (middle + size * wave)
            one[:, c] = 0.0 if quiet else fade * np.clip(played, low[c], high[c])
    if len(others):
        found[: len(others)] = fade[:, None] * np.clip(others, low, high)
    most = slew_per_s / rate_hz
    for k in range(1, samples):
        found[:, k] = np.clip(found[:, k], found[:, k - 1] - most, found[:, k - 1] + most)
    # One that is cut short by that ends at rest all the same, so that any other may follow.
    found[:, -1] = 0.0
    for k in range(samples - 2, -1, -1):
        found[:, k] = np.clip(found[:, k], found[:, k + 1] - most, found[:, k + 1] + most)
    return found


def _hz(band_hz: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(band_hz))))


def _sines(t: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    count = int(np.exp(rng.uniform(0.0, np.log(_MOST_LINES + 1))))
    lines = np.sum([np.sin(2 * np.pi * (_hz(band_hz, rng) * t + rng.random())) for _ in range(count)], axis=0)
    # Peaks beyond 2.1 standard deviations are cut, as those of a multisine.
    return lines if count == 1 else lines / (2.1 * lines.std())


def _sweep(t: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    hz = np.geomspace(_hz(band_hz, rng), _hz(band_hz, rng), t.size)
    return np.sin(2 * np.pi * (np.cumsum(hz) * (t[1] - t[0]) + rng.random()))
