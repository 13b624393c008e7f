"""Four estimates of a link's delay from one recording: ours, mujoco.sysid, PACE's form, and the peak of a correlation.

All but the last fit the same servo: stiffness, damping, dry friction and inertia.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import least_squares

from benches.latency.links import NOISE_RAD, Log, motion
from benches.recorded import rigs
from benches.recorded.sets import Recording
from sim2real.identify.delays.likelihood import DelayEvidence
from sim2real.identify.delays.links import describe, find

STEP_S, LONGEST_S = 0.001, 0.08
GUESS = {"kp": 14.0, "damping": 0.6, "friction": 0.05, "armature": 0.03}
"""Assumed values of the servo before it is fitted, by every method."""
_DIFFERENCE, _EVERY = 0.01, 2
PACE_STEP_S, PACE_S = 0.0025, 8.0
"""PACE's time step, whose multiples its delays are, and the processor time of its search, restarts included [s]."""
Ends = tuple[float, float] | None


@dataclass(frozen=True)
class Estimate:
    """An estimate of a link: times with the commands' delay [s], and 95 % intervals; None: the method gives none."""

    mean: float
    p95: float
    lost: float = 0.0
    mean95: Ends = None
    p95_95: Ends = None


def ours(log: Log, seed: int) -> Estimate:
    """Fit the servo and one constant delay, then the distribution of the delays, as ``identify --links`` does."""
    del seed  # it draws nothing
    names, grid = list(GUESS), np.arange(0.0, LONGEST_S + STEP_S / 2, STEP_S)

    def angles(x: np.ndarray) -> np.ndarray:
        servo = dict(zip(names, np.exp(x).tolist(), strict=True))
        return motion(log.t, log.goal, float(log.t[-1]) + 0.01, STEP_S, **servo)

    def at(stamps: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        return np.interp(stamps, STEP_S * np.arange(len(simulated)), simulated)

    def constant(x: np.ndarray) -> np.ndarray:
        return (at(log.t - x[-1], angles(x[:-1])) - log.position)[::_EVERY] / NOISE_RAD

    begin = np.append(np.log(list(GUESS.values())), 0.01)
    limits = (begin - np.append(np.full(4, 2.5), 0.01), begin + np.append(np.full(4, 2.5), LONGEST_S - 0.03))
    first = least_squares(constant, begin, bounds=limits, diff_step=_DIFFERENCE, x_scale=np.append(np.ones(4), 0.01))

    def linearise(x: np.ndarray, delay_s: float) -> DelayEvidence:
        simulated, stamps = angles(x), log.t - delay_s
        errors = at(log.t[:, None] - grid, simulated) - log.position[:, None]
        slopes = [at(stamps, angles(x + s) - simulated) / _DIFFERENCE for s in _DIFFERENCE * np.eye(len(x))]
        J = np.stack(slopes, axis=1)[:, None] / NOISE_RAD
        return DelayEvidence(log.t - log.t.mean(), grid, errors[:, None] / NOISE_RAD, J, 1e-2 * np.eye(len(x)))

    again = np.concatenate([[False], np.diff(log.position) == 0.0])
    estimate = find(linearise, first.x[:-1], float(first.x[-1]), again)
    link = describe("measurements", ("measurements", "commands"), estimate)
    ends = [(float(r.low95 or 0.0), float(r.high95 or 0.0)) for r in (link.mean, link.p95)]
    return Estimate(float(link.mean.value or 0.0), float(link.p95.value or 0.0), float(link.lost.value or 0.0), *ends)


def _put_friction(spec: mujoco.MjSpec, value: float) -> None:
    rigs.put_friction(spec, value)
    joint = spec.joint(rigs.JOINT)
    joint.solref_friction, joint.solimp_friction[:2] = [2 * spec.option.timestep, 1.0], 0.999


def _problem(log: Log, step_s: float) -> tuple[rigs.Rig, Recording]:
    """Return the servo as a rig, and the recording for the toolbox."""
    puts = {"kp": rigs.put_kp, "damping": rigs.put_damping, "friction": _put_friction, "armature": rigs.put_armature}
    rows = {name: (guess, guess / 5, guess * 5, puts[name]) for name, guess in GUESS.items()}
    spec, start = rigs.hinge(step_s, 1e-9, 0.1, 0.01), np.array([[log.position[0], 0.0]])
    recording = Recording(log.t, log.goal[:, None], log.position[:, None], start)
    return rigs.Rig(lambda r: [rigs.Run(r, spec)], rows, {}, rows), recording


def sysid(log: Log, seed: int) -> Estimate:
    """Fit the servo and mujoco.sysid's delay of the sensor, with its simulated linearised interval."""
    del seed
    rig, recording = _problem(log, STEP_S)
    fit = rigs.fit_once(rig, [recording], delay=True, iterations=25)
    # The toolbox stamps a reading at the end of the step at whose begin it was taken.
    low, high = fit.interval95["delay"]
    return _constant(fit.value("delay") + 0.5 * STEP_S, (low + 0.5 * STEP_S, high + 0.5 * STEP_S))


def pace(log: Log, seed: int) -> Estimate:
    """Fit the servo, an encoder's bias and a delay in whole steps by CMA-ES, as PACE does; it gives no interval."""
    rig, recording = _problem(log, PACE_STEP_S)
    return _constant(rigs.fit_pace(rig, [recording], PACE_S, seed).value("delay") + 0.5 * PACE_STEP_S)


def correlation(log: Log, seed: int) -> Estimate:
    """Return the lag at which the measured positions correlate most with the goals."""
    del seed
    lags = np.arange(0.0, 3 * LONGEST_S, STEP_S)
    held = [log.goal[np.maximum(np.searchsorted(log.t, log.t - lag, side="right") - 1, 0)] for lag in lags]
    return _constant(float(lags[int(np.argmax([np.corrcoef(g, log.position)[0, 1] for g in held]))]))


def _constant(delay_s: float, ends: Ends = None) -> Estimate:
    """Return a delay that is the same for all messages."""
    return Estimate(delay_s, delay_s, 0.0, ends, ends)


METHODS: dict[str, Callable[[Log, int], Estimate]] = {
    "ours": ours, "sysid": sysid, "pace": pace, "correlation": correlation,
}  # fmt: skip


def timed(method: str, log: Log, seed: int) -> tuple[Estimate, float]:
    """Return the estimate of a method, and its processor time [s]."""
    begin = time.process_time()
    return METHODS[method](log, seed), time.process_time() - begin
