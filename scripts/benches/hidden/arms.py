"""Arms with hidden parameters, delays and loads, on a clock of their own: none of the code that trains moves them.

C MuJoCo and the servos of the emulator are stepped by 0.5 ms. A loop of 50 Hz measures them late, in whole counts, and
commands them late; latencies jitter, and the computer pauses. The stages get only the log, as of any robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benches.hidden.robots import RATE_HZ, one_after_another, write_log

PLANT_STEP_NS = 500_000
MOST_KG = 0.15
"""Largest load in the hand [kg]; all trainings draw theirs up to it."""
Act = Callable[[Any, int], np.ndarray]
"""Reading and step -> goals [rad]."""


@dataclass(frozen=True)
class HiddenArm:
    """An arm on a day: a unit, with a load and a computer's timing; times in [s].

    Attributes:
        name: Of the pipeline.
        plant: Arguments of its plant, without the load.
        sensing: Mean age of a measurement.
        acting: Mean time from a command to its effect.
        jitter: Largest deviation of each.
        pauses: Pauses of the computer in a second, and their mean length.
        seed: Of jitter and pauses.
    """

    name: str
    plant: Mapping[str, Any]
    sensing: float
    acting: float
    jitter: float
    pauses: tuple[float, float]
    load_kg: float
    seed: int

    @staticmethod
    def draw(name: str, unit: int, day: int) -> HiddenArm:
        """Draw a unit around the embedded arm's parameters, 12 to 45 ms late, and a day with a load and pauses."""
        rng = np.random.default_rng([20261129, unit])
        factors = rng.uniform(-1.0, 1.0, 6)
        if name == "arm":
            plant: dict[str, Any] = {
                "stall": 0.87 * (1 + 0.15 * factors[0]),
                "back_emf": 1.1 * (1 + 0.2 * factors[1]),
                "armature": 1.25 * (1 + 0.2 * factors[2]),
                "coulomb": (np.array([1.5, 1.9, 1.2]) * (1 + 0.4 * factors[3:])).tolist(),
            }
        else:
            spreads = {"gain": 0.15, "damping": 0.2, "friction": 0.4}
            plant = {what: 1 + spread * factors[i] for i, (what, spread) in enumerate(spreads.items())}
        total, share = rng.uniform(0.012, 0.045), rng.uniform(0.3, 0.7)
        today = np.random.default_rng([20261129, unit, 1 + day])
        return HiddenArm(
            name=name,
            plant=plant,
            sensing=share * total,
            acting=(1 - share) * total,
            jitter=today.uniform(0.0, 0.003),
            pauses=(today.uniform(0.0, 1.5), 0.03),
            load_kg=today.uniform(0.0, MOST_KG),
            seed=1000 * unit + day,
        )


@dataclass(frozen=True)
class Played:
    """A session.

    Attributes:
        t_s: Times ``(T,)`` of the true states [s].
        states: Name -> true states ``(T,)``.
        energy_j: Integral of the power, without its sign, of the torques that the servos' controllers ask for [J].
        times: Node -> starts of its steps, and ends, ``(N,)`` [s].
        readings: The sensor's messages.
        goals: Commands ``(N, joints)`` [rad].
    """

    t_s: np.ndarray
    states: dict[str, np.ndarray]
    energy_j: float
    times: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]
    readings: list[Any]
    goals: np.ndarray


class _States:
    """The true states of a plant, in the place of a truth file."""

    def __init__(self, plant: Any) -> None:
        self._plant, self.rows, self.power_w = plant, [], []

    def write(self, kind: int, servo: int, t_host_ns: int, t_ns: int, done_ns: int, late_ns: int, values: Any) -> None:
        from sim2real.emulation.truth import Kind

        if kind == Kind.STATE:
            data = self._plant.data
            self.rows.append((1e-9 * t_ns, *values))
            self.power_w.append(float(np.abs(data.qfrc_applied * data.qvel).sum()))


def play(arm: HiddenArm, robot: Any, act: Act, seconds: float, session: int) -> Played:
    """Run a session from rest; ``session`` is the seed of jitter and pauses."""
    from sim2real.emulation.plant import PlantClock
    from sim2real.hardware.device import OperatingMode
    from sim2real.hardware.dynamixel import RAD_PER_COUNT, RAD_S_PER_COUNT
    from sim2real.robots.messages import JointReading
    from sim2real.stages.load import load_module

    servos = robot.drive.servos
    more = {"start": servos.at_rest.tolist()} if arm.name == "so101" else {}
    kind = {"arm": "ArmPlant", "so101": "SO101Plant"}[arm.name]
    plant = getattr(load_module(arm.name, "plant"), kind)(**arm.plant, carried_kg=arm.load_kg, **more)
    zero = np.array([plant.measure(i)[0] for i in servos.ids])
    zero -= [plant.state()[f"position[{j}]"] for j in range(len(servos.ids))]
    # Draw all times first: computation, ages of measurements, delays of commands.
    rng, count = np.random.default_rng([arm.seed, session]), int(seconds * RATE_HZ)
    took = {n: 1e-4 + rng.gamma(4.0, s, count) for n, s in (("sensor", 2e-4), ("agent", 3e-5), ("actuator", 1.5e-4))}
    pause = rng.random(count) < arm.pauses[0] / RATE_HZ
    took["agent"] += np.where(pause, rng.gamma(4.0, arm.pauses[1] / 4.0, count), 0.0)
    ages, lags = (
        np.maximum(mean + rng.uniform(-arm.jitter, arm.jitter, count), 0.0) for mean in (arm.sensing, arm.acting)
    )
    *begun, sent = one_after_another(count, took)
    starts = dict(zip(took, begun, strict=True))
    ends = {n: starts[n] + took[n] for n in starts}
    acts = np.maximum.accumulate(sent + lags)
    # Let the loop run, with the torque on from the start.
    truth = _States(plant)
    clock = PlantClock(plant, PLANT_STEP_NS, round(1e9 * (arm.sensing + arm.jitter)), truth)  # type: ignore[arg-type]
    mode, readings, goals = int(OperatingMode.POSITION), [], []
    for servo_id, at in zip(servos.ids, zero + servos.at_rest, strict=True):
        clock.configure(servo_id, servos.sheet.p_gain, 0, servos.sheet.profile_rad_s)
        clock.schedule(0, 0, servo_id, mode, float(at))
    for k in range(count):
        at_ns = round(1e9 * starts["sensor"][k])
        clock.advance(at_ns)
        sampled = np.array([clock.sample(i, at_ns - round(1e9 * ages[k]))[:2] for i in servos.ids])
        position = np.round(sampled[:, 0] / RAD_PER_COUNT) * RAD_PER_COUNT - zero
        velocity = np.round(sampled[:, 1] / RAD_S_PER_COUNT) * RAD_S_PER_COUNT
        readings.append(JointReading(position.astype(np.float32), velocity.astype(np.float32)))
        goals.append(np.asarray(act(readings[-1], k), np.float64))
        for servo_id, goal in zip(servos.ids, goals[-1] + zero, strict=True):
            clock.schedule(round(1e9 * acts[k]), 0, servo_id, mode, float(goal))
    rows = np.array(truth.rows)
    states = dict(zip(plant.state(), rows[:, 1:].T, strict=True))
    energy_j = float(np.mean(truth.power_w) * rows[-1, 0])
    return Played(rows[:, 0], states, energy_j, (starts, ends), readings, np.array(goals))


def record(path: Path, arm: HiddenArm, robot: Any, seconds: float) -> None:
    """Write the log of the excitation of ``record``, played to an arm without a load."""
    from sim2real.robots.messages import Goals
    from sim2real.robots.nodes import approached
    from sim2real.stages.session.excitation import excitation

    config = replace(robot.defaults.record, duration_s=seconds, seed=arm.seed)
    signal = excitation(config, robot.drive.rate_hz, len(robot.task.action))
    goals = approached(signal + robot.drive.centre, robot.drive.servos.at_rest, robot.drive.rate_hz)
    played = play(replace(arm, load_kg=0.0), robot, lambda reading, k: goals[k], len(goals) / RATE_HZ, 0)
    commands = [Goals(row.astype(np.float32)) for row in played.goals]
    write_log(path, robot.name, played.times, played.readings, commands, {**robot.units})


def agent(robot: Any, runner: Callable[[np.ndarray], np.ndarray], trial: int) -> Act:
    """Return a policy as the robot runs it: its node in numpy, with the aim of a trial."""
    from sim2real.graph.base import GraphState, StepState
    from sim2real.robots.agent import AgentParams
    from sim2real.robots.loop import AGENT, SENSOR
    from sim2real.robots.nodes import in_numpy

    node = robot.task.make_agent(robot.drive.rate_hz)
    params = in_numpy(AgentParams.of(robot.task.at_rest(trial)))
    state = in_numpy(node.init_state(None, GraphState(params={AGENT: params})))

    def act(reading: Any, k: int) -> np.ndarray:
        nonlocal state
        heard: Any = {SENSOR: [SimpleNamespace(data=reading)]}
        now: Any = StepState(state=state, params=params, inputs=heard, seq=k)
        after, decision = node.act(now, np.asarray(runner(node.observe(now)), np.float32))
        state = after.state
        return np.asarray(decision.command)

    return act


def judge(arm: HiddenArm, robot: Any, task: str, act: Act, trial: int, seconds: float) -> dict[str, float]:
    """Return the figures of a session with a trial's aim, by the true motion of the tip."""
    from benches.hidden.targets import CLOSE_M, SETTLED_S, arrival

    played = play(arm, robot, act, seconds, 1 + trial)
    tip = np.stack([played.states[f"tip[{i}]"] for i in range(3)], axis=-1)
    aim, drawn = robot.task.aim, np.asarray(robot.task.at_rest(trial).aim)
    at = drawn[None] if aim.at is None else np.stack([aim.at(drawn, t)[:3] for t in played.t_s])
    distance = np.linalg.norm(tip - at, axis=-1)
    figures = {"energy_j": played.energy_j}
    if task == "fast":
        return {**figures, **arrival(played.t_s, distance)}
    later = distance[played.t_s >= SETTLED_S]
    return {**figures, "error_m": float(later.mean()), "success": float((later < CLOSE_M).mean())}
