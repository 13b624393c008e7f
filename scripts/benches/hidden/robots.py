"""Pendulums with random parameters, simulated on their own clock without the package.

A disk on a servo is integrated in steps of 0.5 ms. A loop of 50 Hz measures it late, with jitter, an encoder's counts
and play, and commands it late; some bus answers are lost. The stages get only the log, as of any robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.graph.episode import MessageRecord, StepRecord
from sim2real.log.writer import McapRecorder

RATE_HZ, STEP_S = 50.0, 5e-4
COUNT_RAD, SPEED_COUNT_RAD_S = 2 * math.pi / 4096, 0.229 * 2 * math.pi / 60
SHEET = {"gain": 26.96, "gravity": 129.5, "damping": 0.99, "friction": 6.1}
"""The pendulum's data sheet, the centre of all draws: [rad/s^2/V], [rad/s^2], [1/s], [rad/s^2]."""
SPREAD = 0.3
_RETRY_S = 0.004
SPEED_NOISE = 15.0
"""Noise of a speed over that of an angle [1/s]."""
Controller = Callable[[float, float], float]
"""Angle [rad] and angular velocity [rad/s], as measured -> voltage [V]."""


@dataclass(frozen=True)
class Wear:
    """Limits of the defects of drawn robots.

    Attributes:
        jitter_s: Largest deviation of either latency [s].
        lost: Share of lost answers, for robots with losses.
        play_rad: Half of the encoder's backlash, for robots with backlash [rad].
        noise_rad: Largest deviation of the encoder's noise [rad]; the speed's is 15 times that [rad/s].
        hiccups_hz: Pauses of the computer a second.
        hiccup_s: Their mean length [s].
    """

    jitter_s: float = 0.003
    lost: float = 0.02
    play_rad: float = 0.008
    noise_rad: float = 0.0
    hiccups_hz: float = 0.0
    hiccup_s: float = 0.0


@dataclass(frozen=True)
class Hidden:
    """A robot; times in [s].

    Attributes:
        gain: Acceleration per volt [rad/s^2/V].
        gravity: Largest acceleration by gravity [rad/s^2].
        damping: Of the speed [1/s].
        friction: Coulomb friction [rad/s^2].
        sensing: Mean age of a measurement.
        acting: Mean time from a command to the motor.
        jitter: Deviation of each.
        lost: Share of lost answers, which are requested again.
        play: Half of the encoder's backlash [rad].
        noise: Deviation of the encoder's noise [rad].
        hiccups: Pauses of the computer per second, and their mean length.
        seed: Of jitter and losses.
    """

    gain: float
    gravity: float
    damping: float
    friction: float
    sensing: float
    acting: float
    jitter: float
    lost: float
    play: float
    noise: float
    hiccups: tuple[float, float]
    seed: int

    @staticmethod
    def draw(seed: int, wear: Wear = Wear()) -> Hidden:
        """Draw a robot: within 30 % of the data sheet, 10 to 60 ms late, a third each with losses, play, a payload."""
        rng = np.random.default_rng([20261123, seed])
        parameters = {n: v * rng.uniform(1 - SPREAD, 1 + SPREAD) for n, v in SHEET.items()}
        total, share = rng.uniform(0.010, 0.060), rng.uniform(0.3, 0.7)
        losses, play, payload = rng.random(3) < 1 / 3
        if payload:  # the inertia grows, so that the motor gets weaker
            parameters["gain"] *= 0.85
        return Hidden(
            **parameters,
            sensing=share * total,
            acting=(1 - share) * total,
            jitter=rng.uniform(0.0, wear.jitter_s),
            lost=wear.lost * losses,
            play=wear.play_rad * play,
            noise=wear.noise_rad * rng.uniform(0.3, 1.0),
            hiccups=(wear.hiccups_hz, wear.hiccup_s),
            seed=seed,
        )


@dataclass(frozen=True)
class Played:
    """One session.

    Attributes:
        t: Shape ``(T,)``: times of the true motion [s].
        angle: Shape ``(T,)``: true angle [rad]; 0 is upright.
        speed: Shape ``(T,)`` [rad/s].
        starts: Node -> starts of its steps ``(N,)`` [s].
        ends: Node -> ends ``(N,)`` [s].
        measured: Shape ``(N, 2)``: angle and angular velocity as the sensor sent them.
        volts: Shape ``(N,)``: commands [V].
    """

    t: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    starts: dict[str, np.ndarray]
    ends: dict[str, np.ndarray]
    measured: np.ndarray
    volts: np.ndarray


def play(robot: Hidden, controller: Controller, seconds: float, session: int) -> Played:
    """Run a session from rest, hanging; ``session`` is the seed of jitter and losses."""
    # Draw all times first: computation, ages of measurements, delays of commands.
    rng = np.random.default_rng([robot.seed, session])
    count, steps = int(seconds * RATE_HZ), int(seconds / STEP_S) + 1
    angle, speed, encoder = np.zeros(steps), np.zeros(steps), np.zeros(steps)
    angle[0] = encoder[0] = math.pi
    took = {n: 1e-4 + rng.gamma(4.0, s, count) for n, s in (("sensor", 2e-4), ("agent", 3e-5), ("actuator", 1.5e-4))}
    took["sensor"] += _RETRY_S * (rng.random(count) < robot.lost)
    took["actuator"] += _RETRY_S * (rng.random(count) < robot.lost)
    ages = np.maximum(rng.normal(robot.sensing, robot.jitter, count), 0.0)
    lags = np.maximum(rng.normal(robot.acting, robot.jitter, count), 0.0)
    if robot.hiccups[0]:
        paused = rng.random(count) < robot.hiccups[0] / RATE_HZ
        took["agent"] += np.where(paused, rng.gamma(4.0, robot.hiccups[1] / 4.0, count), 0.0)
    noise = robot.noise * np.array([1.0, SPEED_NOISE]) * rng.standard_normal((count, 2)) if robot.noise else None
    t_step, begin_agent, begin_actuator, sent = one_after_another(count, took)
    acts = np.maximum.accumulate(sent + lags)
    # Integrate up to each measurement, with the commands that act until then.
    measured, volts = np.zeros((count, 2)), np.zeros(count)
    now, done = 0, -1
    for k in range(count):
        while now * STEP_S < t_step[k] and now + 1 < steps:
            while done + 1 < k and acts[done + 1] <= now * STEP_S:
                done += 1
            _advance(robot, angle, speed, encoder, now, volts[done] if done >= 0 else 0.0)
            now += 1
        at = max(0, min(now, round((t_step[k] - ages[k]) / STEP_S)))
        angle_now, speed_now = (encoder[at], speed[at]) if noise is None else (encoder[at], speed[at]) + noise[k]
        measured[k] = (
            round(angle_now / COUNT_RAD) * COUNT_RAD,
            round(speed_now / SPEED_COUNT_RAD_S) * SPEED_COUNT_RAD_S,
        )
        volts[k] = controller(*measured[k])
    starts = {"sensor": t_step, "agent": begin_agent, "actuator": begin_actuator}
    ends = {n: starts[n] + took[n] for n in starts}
    times = np.arange(now + 1) * STEP_S
    return Played(times, angle[: now + 1], speed[: now + 1], starts, ends, measured, volts)


def one_after_another(count: int, took: dict[str, np.ndarray], rate_hz: float = RATE_HZ) -> tuple[np.ndarray, ...]:
    """Return the starts of the steps of sensor, agent and actuator, and the ends of the last, all ``(N,)`` [s].

    A node waits for its input, and for the end of its own last step.

    Args:
        took: Node -> duration of its steps ``(N,)`` [s].
    """
    starts = {n: np.zeros(count) for n in took}
    ends = {n: np.zeros(count) for n in took}
    for k in range(count):
        ready = k / rate_hz
        for node in ("sensor", "agent", "actuator"):
            starts[node][k] = max(ready, ends[node][k - 1]) if k else ready
            ready = ends[node][k] = starts[node][k] + took[node][k]
    return starts["sensor"], starts["agent"], starts["actuator"], ends["actuator"]


def _advance(robot: Hidden, angle: np.ndarray, speed: np.ndarray, encoder: np.ndarray, i: int, volts: float) -> None:
    """Integrate one step: semi-implicit, with friction."""
    pushed = robot.gain * volts + robot.gravity * math.sin(angle[i]) - robot.damping * speed[i]
    free = speed[i] + STEP_S * pushed
    speed[i + 1] = math.copysign(max(abs(free) - STEP_S * robot.friction, 0.0), free)
    angle[i + 1] = angle[i] + STEP_S * speed[i + 1]
    encoder[i + 1] = min(max(encoder[i], angle[i + 1] - robot.play), angle[i + 1] + robot.play)


def excited(seconds: float, seed: int, volts: float = 1.8) -> Controller:
    """Return a multisine of at most ``volts``."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    tones, phases = np.linspace(0.2, 3.0, 24), rng.uniform(0, 2 * np.pi, 24)
    signal = np.sin(2 * np.pi * tones * t[:, None] + phases).sum(axis=1)
    rows = iter(volts * signal / np.abs(signal).max())
    return lambda angle, speed: float(next(rows))


def probed(volts: float = 1.5, steps: int = 8) -> Controller:
    """Return the small steps that measure the delay before a deployment: to both sides, each from rest."""
    count, left, still = 0, 0, 0

    def act(angle: float, speed: float) -> float:
        nonlocal count, left, still
        del angle
        left, still = max(left - 1, 0), 0 if left or abs(speed) > 0.05 else still + 1
        if still >= 5 and count < steps:
            count, left, still = count + 1, 8, 0
        return volts * (-1) ** count if left else 0.0

    return act


def write(path: Path, session: Played, summary: Mapping[str, Any] | None = None) -> None:
    """Write a session's log."""
    readings = [{"th": np.float32(th), "thdot": np.float32(thdot)} for th, thdot in session.measured]
    commands = [{"action": np.array([volts], np.float32)} for volts in session.volts]
    units = {"th": "rad", "thdot": "rad/s", "action": "V"}
    write_log(path, "pendulum", (session.starts, session.ends), readings, commands, units, summary)


def write_log(
    path: Path,
    pipeline: str,
    times: tuple[dict[str, np.ndarray], dict[str, np.ndarray]],
    readings: Sequence[Any],
    commands: Sequence[Any],
    units: Mapping[str, str],
    summary: Mapping[str, Any] | None = None,
) -> None:
    """Write the log of a loop of sensor, agent and actuator.

    Args:
        times: Node -> starts, and ends, of its steps ``(N,)`` [s].
        readings: The sensor's output of each step: a message, or a mapping of fields.
        commands: The output of agent and actuator of each step, likewise.
        summary: What the session says at its end.
    """
    nodes = {"sensor": None, "agent": "sensor", "actuator": "agent"}
    graph = {
        n: {"rate_hz": RATE_HZ, "delay_s": 0.002, "inputs": {s: {"from": s, "blocking": True}} if s else {}}
        for n, s in nodes.items()
    }
    outputs = {n: readings[0] if n == "sensor" else commands[0] for n in nodes}
    metadata = {"pipeline": pipeline, "graph": graph, "units": dict(units)}
    recorder = McapRecorder(path, metadata, {}, outputs, [(n, s) for n, s in nodes.items() if s], {})
    recorder.start(1_790_000_000_000_000_000, 0)
    ticks = lambda seconds: round(1e6 * seconds)  # noqa: E731
    for k, (sensed, sent) in enumerate(zip(readings, commands, strict=True)):
        for node, sender in nodes.items():
            start, end = (ticks(of[node][k]) for of in times)
            recorder.step(StepRecord(node, k, start, start, start, -1, end, 0), sensed if node == "sensor" else sent)
            if sender:
                recorder.message(MessageRecord(node, sender, k, k, start, start))
    recorder.close("finished", 0, dict(summary or {}))
