"""Logs of a motor over five links, made without the package: what identification has to find is known.

A motor with a spring, ``q'' = k u - b q' - c q``, integrated in steps of 0.1 ms, hears commands a fixed time after they
were sent. Each measurement is of the motion a hidden time before its stamp, with noise and an encoder's counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

KINDS = ("gamma", "bimodal", "usb", "bursts", "drift")
COMMANDS_S, MEASURED_S, SPREAD_S = 0.02, 0.0101, 0.003
"""Periods of commands and measurements, and by how much the latter is irregular [s]."""
COMMAND_DELAY_S = 0.006
DYNAMICS = (60.0, 4.0, 40.0)
"""Gain [rad/s^2/V], damping [1/s], spring [1/s^2]."""
NOISE_RAD, COUNT_RAD = 1.5e-3, 2 * np.pi / 4096
DRIFT = 150e-6


@dataclass(frozen=True)
class Log:
    """A log.

    Attributes:
        sent: Shape ``(K,)``: when commands were sent [s].
        commands: Shape ``(K,)`` [V].
        stamps: Shape ``(N,)``: stamps of the measurements [s].
        angles: Shape ``(N,)``: what was measured [rad].
        duration_s: How long it is [s].
    """

    sent: np.ndarray
    commands: np.ndarray
    stamps: np.ndarray
    angles: np.ndarray
    duration_s: float


@dataclass(frozen=True)
class Truth:
    """What a link really does: times in [s], the mean and the 95th percentile with the commands' delay."""

    mean: float
    deviation: float
    p95: float
    lost: float
    burst: float
    drift: float


def motion(
    dynamics: np.ndarray, volts: np.ndarray, step_s: float, start: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Return the angle at the beginning of each step ``(T,)``, for voltages ``(T,)`` that hold for a step."""
    gain, damping, spring = dynamics
    A, B = np.array([[0.0, 1.0], [-spring, -damping]]), np.array([[0.0], [gain]])
    F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), step_s)
    above = np.array([0.0, G[0, 0], F[0, 1] * G[1, 0] - F[1, 1] * G[0, 0]])
    below = np.array([1.0, -np.trace(F), np.linalg.det(F)])
    first = F[0] @ np.array(start) + G[0, 0] * volts[0]
    return lfilter(above, below, volts, zi=[start[0], first - above[1] * volts[0] + below[1] * start[0]])[0]


def held(sent: np.ndarray, commands: np.ndarray, duration_s: float, step_s: float) -> np.ndarray:
    """Return the mean voltage of each step ``(T,)``; a command acts from its delay after it was sent."""
    edges = np.concatenate([[-1.0], sent + COMMAND_DELAY_S, [duration_s + 1.0]])
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([commands[:1], commands]) * np.diff(edges))])
    at = np.arange(round((duration_s + 0.1) / step_s) + 1) * step_s
    return np.diff(np.interp(at, edges, total)) / step_s


def delays(kind: str, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return how long measurements made at ``t (N,)`` are under way [s], and which of them are lost."""
    lost = np.zeros(len(t), bool)
    if kind == "gamma":
        return 0.003 + rng.gamma(2.5, 0.002, len(t)), lost
    if kind == "bimodal":
        slow = rng.random(len(t)) < 0.3
        return np.where(slow, rng.normal(0.017, 0.001, len(t)), rng.normal(0.005, 0.0007, len(t))), lost
    if kind == "usb":  # the adapter passes on what it has when its timer of 16 ms fires
        return 0.001 + np.mod(0.016 * rng.random() - t, 0.016), lost
    if kind == "bursts":
        draws = rng.random(len(t))
        for i in range(1, len(t)):
            lost[i] = draws[i] < (2 / 3 if lost[i - 1] else 0.03)
        return 0.004 + rng.gamma(4.0, 0.0005, len(t)), lost
    return np.maximum(rng.normal(0.007, 0.0008, len(t)), 0.0), lost


def sampled(duration_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return when measurements are made [s]."""
    t = np.arange(0.3, duration_s - 0.1, MEASURED_S)
    return t + rng.uniform(0.0, SPREAD_S, len(t))


def log(kind: str, duration_s: float, seed: int) -> Log:
    """Make a log over a link."""
    rng, step_s = np.random.default_rng(seed), 1e-4
    sent = np.arange(0.0, duration_s, COMMANDS_S)
    sent = sent + rng.uniform(0.0, 0.002, len(sent))
    waves, phases = rng.uniform(0.3, 3.0, 8), rng.uniform(0.0, 2 * np.pi, 8)
    commands = 0.6 * np.sin(2 * np.pi * waves * sent[:, None] + phases).sum(axis=1)
    volts = held(sent, commands, duration_s, step_s)
    angle = motion(np.array(DYNAMICS), volts, step_s)
    t = sampled(duration_s, rng)
    took, lost = delays(kind, t, rng)
    seen = np.interp(t, np.arange(len(angle)) * step_s, angle) + rng.normal(0.0, NOISE_RAD, len(t))
    seen = np.round(seen / COUNT_RAD) * COUNT_RAD
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(t))))  # the reader keeps what it has
    stamps = t + took + (DRIFT * (t - t.mean()) if kind == "drift" else 0.0)
    return Log(sent, commands, stamps, seen[last], duration_s)


def truth(kind: str) -> Truth:
    """Return what a link does in the long run."""
    rng = np.random.default_rng(1)
    took, lost = delays(kind, sampled(2000.0, rng), rng)
    burst = float(lost.sum() / max((np.diff(lost.astype(int)) > 0).sum(), 1))
    mean, p95 = took.mean() + COMMAND_DELAY_S, np.quantile(took, 0.95) + COMMAND_DELAY_S
    drift = DRIFT if kind == "drift" else 0.0
    return Truth(float(mean), float(took.std()), float(p95), float(lost.mean()), burst, drift)
