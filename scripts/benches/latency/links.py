"""Recordings of a position servo in C MuJoCo over six emulated links with given delays.

The servo gets goals a fixed time after they were sent. Each measurement shows the motion a hidden time before its
stamp, with noise and the counts of an encoder. Nothing here uses the package.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.rollout import rollout

KINDS = {
    "fixed": "8 ms",
    "gaussian": "8 ms, deviation 1.5 ms",
    "usb": "half of the messages 1 to 2 ms, half wait for a timer of 16 ms",
    "tail": "4 ms and a Pareto tail: 5 % above 10 ms",
    "losses": "6 ms, 2 % lost, 2 % after a retry of 5 ms",
    "steps": "5 ms, 9 ms after 60 % of the recording, and a clock that gains 100 us/s",
}
"""Link -> its delays, without those of the commands."""
COMMAND_DELAY_S, PERIOD_S, NOISE_RAD, COUNT_RAD = 0.006, 0.01, 5e-4, 2 * np.pi / 4096
DRIFT, RETRIED, LOST = 100e-6, 0.02, 0.02
SERVO = """<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="{armature}" damping="{damping}" frictionloss="{friction}"
 solreffriction="{hold} 1" solimpfriction="0.999 0.999 0.001"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.001 0.001 0.001"/></body></worldbody>
<actuator><position joint="j" kp="{kp}"/></actuator><sensor><jointpos joint="j"/></sensor></mujoco>"""
TRUE = {"kp": 20.0, "damping": 0.9, "friction": 0.1, "armature": 0.02}
"""The hidden servo: N m/rad, N m s/rad, N m, kg m^2."""


@dataclass(frozen=True)
class Log:
    """A recording of a control loop.

    Attributes:
        t: Shape ``(N,)``: when a goal was sent and a measurement was stamped [s].
        goal: Shape ``(N,)`` [rad].
        position: Shape ``(N,)`` [rad].
        lost: Shape ``(N,)``, bool: measurements that repeat the one before.
    """

    t: np.ndarray
    goal: np.ndarray
    position: np.ndarray
    lost: np.ndarray


@dataclass(frozen=True)
class Truth:
    """What a link does in the long run: mean and 95th percentile with the commands' delay [s], share of losses."""

    mean: float
    p95: float
    lost: float


def motion(t: np.ndarray, goal: np.ndarray, length_s: float, step_s: float, **servo: float) -> np.ndarray:
    """Return the servo's angles at the times ``0, step_s, ...``, for goals that hold from the times ``t`` on.

    The integrator applies forces at the begin of a step, half a step early, and damping that is half a step late, which
    acts like an inertia. Both are taken back: a fit would turn them into a delay.
    """
    servo["armature"] = max(servo["armature"] - 0.5 * step_s * servo["damping"], 0.0)
    model = mujoco.MjModel.from_xml_string(SERVO.format(step=step_s, hold=2 * step_s, **servo))
    ticks = step_s * np.arange(round(length_s / step_s))
    # A step in which the goal changes gets the mean of both.
    edges = np.concatenate([[-1.0], t + 0.5 * step_s, [length_s + 1.0]])
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([goal[:1], goal]) * np.diff(edges))])
    control = np.diff(np.interp(np.append(ticks, length_s), edges, total)) / step_s
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    state[1] = goal[0]
    states, _ = rollout(model, mujoco.MjData(model), state[None], control[None, :, None])
    return np.concatenate([[goal[0]], states[0, :-1, 1]])


def delays(kind: str, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays of measurements with the stamps ``t (N,)`` [s], and which of them are lost."""
    n, lost = len(t), np.zeros(len(t), bool)
    if kind == "fixed":
        return np.full(n, 0.008), lost
    if kind == "gaussian":
        return np.maximum(rng.normal(0.008, 0.0015, n), 0.0), lost
    if kind == "usb":
        waits = 0.001 + np.mod(0.016 * rng.random() + t, 0.016)
        return np.where(rng.random(n) < 0.5, rng.uniform(0.001, 0.002, n), waits), lost
    if kind == "tail":
        return np.minimum(0.003 + 0.001 * (1.0 + rng.pareto(1.5, n)), 0.05), lost
    if kind == "losses":
        fate = rng.random(n)
        retried = (fate >= LOST) & (fate < LOST + RETRIED)
        return rng.normal(0.006, 0.0005, n) + 0.005 * retried, fate < LOST
    return np.where(t < 0.6 * t[-1], 0.005, 0.009) + rng.normal(0.0, 0.0003, n) + DRIFT * (t - t.mean()), lost


def log(kind: str, length_s: float, seed: int) -> Log:
    """Record a motion of the servo over a link."""
    rng, step_s = np.random.default_rng(seed), 2.5e-4
    t = np.arange(0.0, length_s, PERIOD_S) + rng.uniform(0.0, 1e-3, round(length_s / PERIOD_S))
    waves, phases = rng.uniform(0.3, 3.0, 6), rng.uniform(0.0, 2 * np.pi, 6)
    goal = 0.15 * np.sin(2 * np.pi * waves * t[:, None] + phases).sum(axis=1)
    angle = motion(t + COMMAND_DELAY_S, goal, length_s + 0.1, step_s, **TRUE)
    took, lost = delays(kind, t, rng)
    noisy = np.interp(t - took, step_s * np.arange(len(angle)), angle) + rng.normal(0.0, NOISE_RAD, len(t))
    counts = np.round(noisy / COUNT_RAD) * COUNT_RAD
    lost[0] = False
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(t))))  # the loop uses the newest that it has
    return Log(t, goal, counts[last], lost)


def truth(kind: str, length_s: float) -> Truth:
    """Return what a link does in many recordings of a length."""
    rng, t = np.random.default_rng(1), np.arange(0.0, length_s, PERIOD_S)
    took, lost = (np.concatenate(x) for x in zip(*(delays(kind, t, rng) for _ in range(200)), strict=True))
    arrived = took[~lost] + COMMAND_DELAY_S
    return Truth(float(arrived.mean()), float(np.quantile(arrived, 0.95)), LOST if lost.any() else 0.0)
