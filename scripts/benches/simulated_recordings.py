"""Recordings of the embedded robots on a simulated clock: their own plants, latencies, encoders and safety gates.

What ``sim2real record`` does in real time, without bus and threads: sensor, supervisor and actuator step one after
another, measurements are as old and commands as late as the robot's emulator says, and the gate stops what it stops.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benches.hidden_robots import COUNT_RAD, SPEED_COUNT_RAD_S, one_after_another, write_log
from sim2real.hardware.device import Reading, Transaction
from sim2real.hardware.plant import OperatingMode, Plant, load_plant
from sim2real.hardware.safety.config import GateLimits
from sim2real.hardware.safety.gate import SafetyGate
from sim2real.hardware.safety.plausibility import Plausibility
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.servo.servo_robot import ServoRobot
from sim2real.stages.pipeline.pipeline import Pipeline

_HISTORY_S = 0.1


@dataclass(frozen=True)
class Session:
    """What a recording left.

    Attributes:
        log: The log.
        truth: Parameter -> true value; delays in [s].
        clamped: Steps whose command a limit of the gate had changed.
        speed_rad_s: Highest speed of each joint ``(joints,)`` [rad/s].
        low_rad: Lowest position of each joint ``(joints,)`` [rad].
        high_rad: Highest.
    """

    log: Path
    truth: dict[str, float]
    clamped: int
    speed_rad_s: np.ndarray
    low_rad: np.ndarray
    high_rad: np.ndarray


class Mechanism:
    """A robot's own plant, driven on its joints' side, with what it did lately."""

    def __init__(self, robot: LoopRobot) -> None:
        assert robot.embedded is not None
        self.plant: Plant = load_plant(robot.embedded.plant, dict(robot.embedded.plant_args))
        self.step_s = robot.embedded.emulator.plant_step_s
        self._goals = isinstance(robot, ServoRobot)
        if isinstance(robot, ServoRobot):
            sheet = robot.servos.sheet
            for i in self.plant.servo_ids:
                self.plant.configure(i, sheet.p_gain, 0, sheet.profile_rad_s)  # pyright: ignore[reportAttributeAccessIssue]
            zeros = [self.plant.state()[f"position[{k}]"] for k in range(len(self.plant.servo_ids))]
            self._zero = self._now()[:, 0] - zeros
        else:
            self._zero = np.zeros(len(self.plant.servo_ids))
        self._supply_v = None if self._goals else robot.make_device("", 0.1).drive.supply_v  # pyright: ignore[reportAttributeAccessIssue]
        self.done = 0
        self._kept = round(_HISTORY_S / self.step_s)
        self._past = np.repeat(self._now()[None], self._kept, axis=0)

    def advance(self, t_s: float) -> None:
        """Step the plant up to a time [s]."""
        while (self.done + 1) * self.step_s <= t_s + 1e-9:
            self.done += 1
            self.plant.advance(self.done * self.step_s)
            self._past[self.done % self._kept] = self._now()

    def command(self, command: np.ndarray) -> None:
        """Command the joints ``(joints,)``, from now on."""
        for k, servo in enumerate(self.plant.servo_ids):
            if self._goals:
                self.plant.command(servo, OperatingMode.POSITION, float(command[k] + self._zero[k]))
            else:
                self.plant.command(servo, OperatingMode.PWM, float(command[k]) / self._supply_v)

    def seen(self, t_s: float) -> np.ndarray:
        """Return positions, speeds and loads as encoders say them at a time of the past, ``(joints, 3)``."""
        found = self._past[min(max(round(t_s / self.step_s), 0), self.done) % self._kept].copy()
        found[:, 0] = np.round(found[:, 0] / COUNT_RAD) * COUNT_RAD - self._zero
        found[:, 1] = np.round(found[:, 1] / SPEED_COUNT_RAD_S) * SPEED_COUNT_RAD_S
        return found

    def _now(self) -> np.ndarray:
        return np.array([self.plant.measure(i) for i in self.plant.servo_ids])


def record(pipeline: Pipeline, limits: GateLimits, signal: np.ndarray, seed: int, log: Path) -> Session:
    """Play commands and write the log.

    Args:
        signal: Shape ``(N, actions)``: one command a step, as ``Robot.around`` returns them.

    Raises:
        SafetyStop: What the gate, or the plausibility of what was measured, stopped.
    """
    robot: LoopRobot = pipeline.load()  # pyright: ignore[reportAssignmentType]
    made, rng, count = Mechanism(robot), np.random.default_rng([20261124, seed]), len(signal)
    emulator = robot.embedded.emulator  # pyright: ignore[reportOptionalMemberAccess]
    took = {n: 1e-4 + rng.gamma(4.0, s, count) for n, s in (("sensor", 2e-4), ("agent", 3e-5), ("actuator", 1.5e-4))}
    for node in ("sensor", "actuator"):
        took[node] += 0.004 * (rng.random(count) < emulator.reply_loss)
    ages, lags = (
        latency + rng.uniform(-jitter, jitter, count)
        for latency, jitter in (
            (emulator.sensing_latency_s, emulator.sensing_jitter_s),
            (emulator.actuation_latency_s, emulator.actuation_jitter_s),
        )
    )
    starts = dict(zip(took, one_after_another(count, took, robot.rate_hz), strict=False))
    sent = starts["actuator"] + took["actuator"]
    acts = np.maximum.accumulate(sent + lags)
    config = robot.gate(limits)
    gate, plausible = SafetyGate(config), Plausibility(config)
    gate.reset(made.seen(0.0)[:, 0] if config.stale == "hold" else None)
    if config.stale == "hold":  # as on hardware, joints come to their signal slowly
        away, gone = made.seen(0.0)[:, 0] - signal[0], np.arange(count)[:, None] / robot.rate_hz
        signal = signal + np.sign(away) * np.maximum(np.abs(away) - gone, 0.0)
    seen, commands, done = np.zeros((count, len(made.plant.servo_ids), 3)), np.zeros_like(signal), 0
    for k in range(count):
        while done < k and acts[done] <= starts["sensor"][k]:
            made.advance(acts[done])
            made.command(commands[done])
            done += 1
        made.advance(starts["sensor"][k])
        seen[k] = made.seen(starts["sensor"][k] - ages[k])
        plausible.check(seen[k, :, 0], starts["sensor"][k], 0.0, seen[k, :, 2])
        commands[k] = gate.apply(signal[k], 0.0, starts["actuator"][k], seen[k, :, 1])
    readings = [robot.read(Reading(*row.T.astype(np.float32), Transaction(0, 0, 0, 0))) for row in seen]
    sent_commands = [robot.message(row.astype(np.float32)) for row in commands]
    ends = {node: starts[node] + took[node] for node in took}
    write_log(log, pipeline.name, (starts, ends), readings, sent_commands, robot.units)
    truth = {n: float(v) for n, v in made.plant.truth().items()}
    truth |= {"round_trip_delay": float(emulator.sensing_latency_s + emulator.actuation_latency_s)}
    position = seen[:, :, 0]
    cut = gate.counts.clamped + gate.counts.slewed
    return Session(log, truth, cut, np.abs(seen[:, :, 1]).max(axis=0), position.min(axis=0), position.max(axis=0))
