"""Excitation signals: commands that make a robot's dynamics identifiable."""

import numpy as np

from sim2real.errors import UsageError
from sim2real.stages.record.config import RecordConfig


def excitation(config: RecordConfig, rate_hz: float, commands: int = 1) -> np.ndarray:
    """Return the commands of all steps, shape ``(N,)`` for one command, else ``(N, commands)`` [the command's unit].

    ``multisine`` is a sum of twelve sines with random phases between ``low_hz`` and ``high_hz``; ``chirp`` sweeps
    between these in 10 s, and back; ``steps`` has random levels, each held for half a period of a random frequency
    between them. All grow from zero during the first 0.5 s and stay within the amplitude. Several commands are
    independent.

    Args:
        config: Kind of excitation, duration, amplitude, frequencies and seed.
        rate_hz: Commands per second [Hz].
    """
    if config.high_hz > rate_hz / 2:
        raise UsageError(
            f"high_hz = {config.high_hz} Hz is above half the command rate of {rate_hz:g} Hz",
            hint=f"choose at most {rate_hz / 2:g} Hz",
        )
    rng = np.random.default_rng(config.seed)
    t = np.arange(round(config.duration_s * rate_hz)) / rate_hz
    make = {"multisine": _multisine, "chirp": _chirp, "steps": _steps}[config.excitation]
    signals = np.stack([make(t, config.low_hz, config.high_hz, rng) for _ in range(commands)], axis=1)
    played = config.amplitude * np.clip(signals, -1.0, 1.0) * np.minimum(1.0, t / 0.5)[:, None]
    return played[:, 0] if commands == 1 else played


def _multisine(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    lines_hz = np.geomspace(low_hz, high_hz, 12)
    phases = rng.uniform(0, 2 * np.pi, lines_hz.size)
    signal = np.sin(2 * np.pi * np.outer(t, lines_hz) + phases).sum(axis=1)
    # Peaks beyond 2.1 standard deviations are clipped at 1: twice the power of a scaling to 3 standard deviations.
    return signal / (3 * signal.std() / np.sqrt(2))


def _chirp(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    sweep = 1.0 - np.abs((t / 10.0) % 2.0 - 1.0)  # 0 to 1 and back in 20 s
    frequency_hz = low_hz * (high_hz / low_hz) ** sweep
    step_s = t[1] - t[0]
    return np.sin(2 * np.pi * np.cumsum(frequency_hz) * step_s + rng.uniform(0, 2 * np.pi))


def _steps(t: np.ndarray, low_hz: float, high_hz: float, rng: np.random.Generator) -> np.ndarray:
    signal = np.empty_like(t)
    step_s, begin = t[1] - t[0], 0
    while begin < t.size:
        hold_s = 0.5 / np.exp(rng.uniform(np.log(low_hz), np.log(high_hz)))
        end = begin + max(1, round(hold_s / step_s))
        signal[begin:end] = rng.uniform(-1.0, 1.0)
        begin = end
    return signal
