"""A textbook's servo: stiffness, damping, dry friction, a delay and a limit of the goal's rate, fitted by scipy.

    q'' = k (goal - q) - d q' - c sign(q') [- g sin(q), with a load] [+ a constant, where the command is a force]

per unit of inertia. ``goal`` is the command, ``delay`` late, and changes by at most ``rate``. Where the command is a
force or a voltage, ``k`` multiplies it, and neither a position nor a rate is fed back. Fitted with
``scipy.optimize.least_squares``, whose Jacobian is of finite differences that are simulated side by side. Recordings
longer than two windows are fitted in windows, each from its measured state; predictions are free runs over a whole one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from benches.recorded.sets import Recording

STEP_S, LONGEST_STEP_S = 0.002, 0.005
WINDOW_S = 5.0
_DIFFERENCE, _NEAR = 1e-4, 4
BOUNDS = {
    "stiffness": (1.0, 1e4, 300.0), "damping": (1e-2, 1e3, 20.0), "dry": (1e-4, 1e3, 0.5), "delay": (1e-4, 0.1, 0.01),
    "rate": (0.2, 100.0, 8.0), "weight": (1.0, 1e3, 50.0), "constant": (-5.0, 5.0, 0.0),
}  # fmt: skip
"""Low, high, and guess; all but the constant are searched on a logarithmic scale."""
FORCE_GAIN = (1e-4, 1e3, 0.05)
"""Of a force or a voltage, in place of the stiffness."""


class _TimeOver(Exception):  # noqa: N818
    """The budget is spent."""


class Servo:
    """Recordings of one joint, on one grid of steps.

    Args:
        force: Whether the command is a force, a torque or a voltage.
        loaded: Whether the joint lifts a mass, and hangs down at 0.
    """

    def __init__(self, recordings: Sequence[Recording], force: bool, loaded: bool) -> None:
        self.recordings, self.force = recordings, force
        self.names = ["stiffness", "damping", "dry", "delay"]
        self.names += ["constant"] * force + ["rate"] * (not force) + ["weight"] * loaded
        limits = BOUNDS | ({"stiffness": FORCE_GAIN} if force else {})
        self._log = np.array([n != "constant" for n in self.names])
        low, high, guess = np.array([limits[n] for n in self.names]).T
        self.low, self.high, self.guess = (
            np.where(self._log, np.log(np.abs(x) + 1e-12), x) for x in (low, high, guess)
        )
        # Pad the recordings to one length.
        period = min(float(np.median(np.diff(r.t))) for r in recordings)
        self.step_s = float(np.clip(period, STEP_S, LONGEST_STEP_S))
        count = max(int(np.ceil((r.t[-1] - r.t[0]) / self.step_s)) for r in recordings) + 2
        self._grid = self.step_s * np.arange(count)
        held = [np.clip(np.searchsorted(r.t - r.t[0], self._grid + 1e-9, "right") - 1, 0, None) for r in recordings]
        gains = np.array([float(r.constants.get("duty_per_rad", 1.0)) for r in recordings])
        on = [r.constants.get("torque_enable", np.ones(len(r.t))) for r in recordings]
        self._gain = np.stack([np.asarray(o, float)[h] for o, h in zip(on, held, strict=True)]) * gains[:, None]
        self._command = np.stack([r.command[h, 0] for r, h in zip(recordings, held, strict=True)])
        self._start = np.array([r.start[0] for r in recordings])

    def simulate(self, x: np.ndarray) -> np.ndarray:
        """Return positions of candidates ``(C, P)`` at every step, ``(steps, C, recordings)``; Euler, speed first."""
        p = dict(zip(self.names, np.where(self._log, np.exp(x), x).T[:, :, None], strict=True))
        q, speed = (np.broadcast_to(s, (len(x), len(self._start))).copy() for s in self._start.T)
        # Delay by interpolation between steps, so that residuals are smooth in it.
        late = p["delay"][:, 0] / self.step_s
        whole, share = np.floor(late).astype(int), (late % 1.0)[:, None]
        positions, goal, dt = np.empty((len(self._grid), *q.shape)), self._command[:, 0] + 0.0 * q, self.step_s
        for i in range(len(self._grid)):
            positions[i] = q
            newer, older = self._command.T[np.maximum(i - whole, 0)], self._command.T[np.maximum(i - whole - 1, 0)]
            command = newer + share * (older - newer)
            if self.force:
                push = p["stiffness"] * self._gain[:, i] * command + p["constant"]
            else:
                goal = np.clip(command, goal - p["rate"] * dt, goal + p["rate"] * dt)
                push = p["stiffness"] * self._gain[:, i] * (goal - q)
            if "weight" in p:
                push = push - p["weight"] * np.sin(q)
            # Damping is implicit; dry friction stops at most the motion of this step.
            speed = (speed + dt * push) / (1.0 + dt * p["damping"])
            speed = np.sign(speed) * np.maximum(np.abs(speed) - dt * p["dry"], 0.0)
            q = np.clip(q + dt * speed, -1e3, 1e3)
        return positions

    def predict(self, x: np.ndarray) -> list[np.ndarray]:
        """Return positions of candidates at the recordings' stamps, ``(C, N)`` each."""
        steps = self.simulate(x)
        predicted = []
        for k, r in enumerate(self.recordings):
            place = np.clip((r.t - r.t[0]) / self.step_s, 0, len(steps) - 2)
            i, share = place.astype(int), (place % 1.0)[:, None]
            predicted.append(((1 - share) * steps[i, :, k] + share * steps[i + 1, :, k]).T)
        return predicted


def windows(recording: Recording) -> list[Recording]:
    """Return a long recording in windows, with states from a line through the samples around their begins."""
    t, parts = recording.t, []
    if t[-1] - t[0] < 2 * WINDOW_S or "torque_enable" in recording.constants:
        return [recording]
    edges = np.searchsorted(t, np.arange(t[0], t[-1] - 0.5 * WINDOW_S, WINDOW_S))
    for begin, end in pairwise([*edges, len(t)]):
        near = slice(max(begin - _NEAR, 0), begin + _NEAR + 1)
        slope, place = np.polyfit(t[near] - t[begin], recording.position[near, 0], 1)
        start = np.array([[place, slope]]) if begin else recording.start
        parts.append(recording.part(begin, end, start))
    return parts


def fit(
    fitted: Sequence[Recording], force: bool, loaded: bool, budget_s: float, seed: int
) -> tuple[Callable[[Sequence[Recording]], list[np.ndarray]], str]:
    """Fit one joint within a budget, from several places; return its predictor and a summary."""
    deadline, rng = time.process_time() + budget_s, np.random.default_rng(seed)
    parts = [w for r in fitted for w in windows(r)]
    servo, measured = Servo(parts, force, loaded), np.concatenate([r.position[:, 0] for r in parts])
    best, lowest, evaluations, starts = servo.guess, np.inf, 0, 0

    def residuals(candidates: np.ndarray) -> np.ndarray:
        nonlocal best, lowest, evaluations
        if evaluations and time.process_time() > deadline:
            raise _TimeOver
        errors = np.concatenate(servo.predict(candidates), axis=1) - measured
        evaluations += len(candidates)
        if (loss := float(np.sum(errors[0] ** 2))) < lowest:
            best, lowest = candidates[0].copy(), loss
        return errors

    def jacobian(x: np.ndarray) -> np.ndarray:
        steps = np.where(x + _DIFFERENCE > servo.high, -_DIFFERENCE, _DIFFERENCE)
        errors = residuals(np.vstack([x, x + np.diag(steps)]))
        return (errors[1:] - errors[0]).T / steps

    start, near = servo.guess, 1e-6 * (servo.high - servo.low)
    try:
        while True:
            starts += 1
            limits = (servo.low - near, servo.high + near)
            least_squares(lambda x: residuals(x[None])[0], start, jacobian, limits, x_scale="jac", max_nfev=60)
            start = rng.uniform(servo.low, servo.high)
    except _TimeOver:
        pass
    summary = f"{evaluations} evaluations, {starts} starts"
    predict = lambda recordings: [p.T for p in Servo(recordings, force, loaded).predict(best[None])]  # noqa: E731
    return predict, summary
