"""The arm and the SO-101 on a simulated clock for the bench of drift.

Plants, latencies and the gate are those of the wall clock; random times replace bus and threads. Robots differ in the
parameters of their servos and in their latencies. The policy is written by hand: it moves the goals from target to
target, as fast as a trained one may. Trained policies run as on the robot: in its agent's node, in numpy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import jax
import numpy as np

from benches.drift.pendulum import DELAY_S, FRICTION
from benches.hidden import robots as hidden
from sim2real.graph.base import StepState
from sim2real.hardware.emulation.truth import TruthLog
from sim2real.hardware.plant import OperatingMode, PlantClock, load_plant
from sim2real.hardware.safety.gate import SafetyGate
from sim2real.robots.control_loop.messages import JointReading
from sim2real.robots.servo.agent import AgentParams, AgentState
from sim2real.stages.excitation.signals import excitation
from sim2real.stages.pipeline.pipeline import load_pipeline

TARGET_S, APPROACH_HZ = 4.0, 4.0
"""Time at each target; rate at which a goal approaches it."""
STEP_RAD, STEP_S, STEPS = 0.12, 0.5, 8
"""Size, duration and number of the small steps that measure the delay."""
CARRIED = 0.3
"""Payload, as a share of the mass of all links."""
_STEP_NS = 500_000
Policy = Callable[[int, np.ndarray, JointReading], np.ndarray]
"""Number of a step, goals of the one before [rad], and the newest measurement -> goals [rad]."""


@dataclass(frozen=True)
class ReachingArm:
    """An arm of position-controlled servos.

    Attributes:
        number: Its number.
        plant: Arguments of its plant.
        sensing_s: Mean age of a measurement [s].
        acting_s: Mean time from a command to the motor [s].
    """

    number: int
    plant: dict[str, Any]
    sensing_s: float
    acting_s: float
    pipeline: ClassVar[str] = "arm"
    links_kg: ClassVar[float] = 0.234
    defaults: ClassVar[dict[str, float]] = {
        "record_s": 40.0, "seconds": 16.0, "episodes": 2, "generations": 30, "steps": 1_500_000, "envs": 256
    }  # fmt: skip
    causes: ClassVar[dict[str, str]] = {"friction": "friction", "payload": "payload", "delay": "round_trip_delay"}

    @classmethod
    def draw(cls, number: int) -> ReachingArm:
        """Draw a robot: within 20 % of the pipeline's, 10 to 28 ms late."""
        rng = np.random.default_rng([20261124, number])
        return cls(number, cls.servos(rng), rng.uniform(0.003, 0.010), rng.uniform(0.007, 0.018))

    @classmethod
    def servos(cls, rng: np.random.Generator) -> dict[str, Any]:
        """Draw the servos' parameters: arguments of the plant."""
        off = lambda: rng.uniform(0.8, 1.2)  # noqa: E731
        coulomb = [off() * factor for factor in (1.5, 1.9, 1.2)]
        return {"stall": 0.87 * off(), "back_emf": 1.1 * off(), "armature": 1.25 * off(), "coulomb": coulomb}

    @property
    def truth(self) -> dict[str, Any]:
        """Its parameters, for the report."""
        return {name: value for name, value in asdict(self).items() if name != "number"}

    def changed(self, change: str) -> ReachingArm:
        """Return the robot after a change; ``none``: no change."""
        if change == "friction":
            return replace(self, plant=self.rubbing(FRICTION))
        if change == "delay":
            return replace(self, acting_s=self.acting_s + DELAY_S)
        if change == "payload":
            return replace(self, plant={**self.plant, "carried_kg": CARRIED * self.links_kg})
        return self

    def rubbing(self, factor: float) -> dict[str, Any]:
        """Return the plant's arguments with more friction in all joints."""
        return {**self.plant, "coulomb": [factor * level for level in self.plant["coulomb"]]}

    def record(self, path: Path, seconds: float, session: int) -> None:
        """Write the log of the pipeline's excitation, which begins slowly at the rest position.

        Args:
            session: Seed of jitter and excitation.
        """
        robot, config = self._robot, load_pipeline(self.pipeline).record
        config = replace(config, duration_s=seconds, seed=1000 * self.number + session)
        signal = robot.drive.around(excitation(config, hidden.RATE_HZ, len(robot.drive.servos.joints)))
        away = np.asarray(robot.drive.servos.at_rest) - signal[0]
        left = np.abs(away) - np.arange(len(signal))[:, None] / hidden.RATE_HZ
        signal = signal + np.sign(away) * np.maximum(left, 0.0)
        self._play(path, lambda k, *_: signal[k], seconds, session)

    def probe(self, path: Path, session: int) -> None:
        """Write the log of the small steps before a deployment: away from rest and back."""
        robot = self._robot
        rest, probe = np.asarray(robot.drive.servos.at_rest, float), robot.drive.probe
        away = rest + STEP_RAD * (np.arange(len(rest)) == probe.joint)
        each = round(STEP_S * hidden.RATE_HZ)
        self._play(path, lambda k, *_: away if k // each % 2 else rest, STEP_S * (STEPS + 1), session)

    def deploy(self, path: Path, seconds: float, session: int) -> float:
        """Write the log of an episode of the policy written by hand; return NaN, as it has no success.

        Args:
            session: Seed of the targets.
        """
        robot, rng = self._robot, np.random.default_rng([self.number, session])
        low, high = self.targets()
        targets = rng.uniform(low, high, (int(seconds / TARGET_S) + 1, len(low)))
        fastest = robot.drive.servos.speed

        def policy(k: int, goal: np.ndarray, _: JointReading) -> np.ndarray:
            way = targets[int(k / hidden.RATE_HZ / TARGET_S)] - goal
            return goal + np.clip(APPROACH_HZ * way, -fastest, fastest) / hidden.RATE_HZ

        self._play(path, policy, seconds, session)
        return float("nan")

    def success(self, bundle: Any, options: Any) -> list[float]:
        """Return 1 for each deployment of a trained policy that ended at the target, else 0."""
        robot, seconds = self._robot, load_pipeline(self.pipeline).deploy.duration_s
        reached = []
        for trial in range(100, 100 + options.trials):
            aim = np.asarray(robot.task.aim.draw(jax.random.key(trial)))
            angles = self._play(Path(os.devnull), trained(robot, bundle, aim), seconds, trial)
            states = {f"position[{i}]": column for i, column in enumerate(angles.T)}
            states |= {f"aim[{i}]": np.full(len(angles), value) for i, value in enumerate(aim)}
            reached.append(robot.task.score(np.arange(len(angles)) / hidden.RATE_HZ, states)["reached"])
        return reached

    def targets(self) -> tuple[Any, Any]:
        """Return lowest and highest joint angles of targets [rad]."""
        module = sys.modules[type(self._robot).__module__]
        return module.LOW, module.HIGH

    @property
    def _robot(self) -> Any:
        return load_pipeline(self.pipeline).load()

    def _play(self, path: Path, policy: Policy, seconds: float, session: int) -> np.ndarray:
        """Run the loop on a simulated clock, from rest, and write its log; return the true angles ``(N, joints)``."""
        # Make the plant at rest, with the servos' settings, and the gate.
        robot, rng = self._robot, np.random.default_rng([self.number, session, 1])
        plant: Any = load_plant(robot.drive.embedded.plant, self.plant)
        sheet, rest = robot.drive.servos.sheet, robot.drive.servos.at_rest
        plant.data.qpos[:] = rest
        truth = TruthLog(Path(os.devnull), {"state_names": list(plant.state())})
        clock = PlantClock(plant, _STEP_NS, 0, round(2e9 * self.sensing_s), truth)
        zero = [plant.measure(i)[0] - angle for i, angle in zip(plant.servo_ids, rest, strict=True)]
        for servo_id in plant.servo_ids:
            clock.configure(servo_id, sheet.p_gain, 0, sheet.profile_rad_s)
        gate = SafetyGate(robot.drive.gate(load_pipeline(self.pipeline).deploy.gate))
        gate.reset(rest)
        goal, count, acts_ns = np.asarray(rest, float), int(seconds * hidden.RATE_HZ), 0
        starts, ends = ({n: np.zeros(count) for n in ("sensor", "agent", "actuator")} for _ in range(2))
        readings, commands, angles = [], [], []
        for k in range(count):
            # Times of the three nodes' steps.
            at = k / hidden.RATE_HZ
            for node, took in (("sensor", 1.2e-3), ("agent", 1e-4), ("actuator", 6e-4)):
                starts[node][k], at = at, at + took * rng.uniform(0.8, 1.2)
                ends[node][k] = at
            # The measurement, one latency before the sensor's step, in the encoder's counts.
            requested_ns = round(1e9 * starts["sensor"][k])
            clock.advance(requested_ns)
            sampled_ns = requested_ns - round(1e9 * self.sensing_s * rng.uniform(0.85, 1.15))
            rows = np.array([clock.sample(i, sampled_ns)[:2] for i in plant.servo_ids])
            angle = np.round(rows[:, 0] / hidden.COUNT_RAD) * hidden.COUNT_RAD - zero
            speed = np.round(rows[:, 1] / hidden.SPEED_COUNT_RAD_S) * hidden.SPEED_COUNT_RAD_S
            readings.append({"position": np.float32(angle), "velocity": np.float32(speed)})
            angles.append(plant.data.qpos.copy())
            # The policy's goals act one latency after the actuator's step.
            goal = gate.apply(policy(k, goal, JointReading(**readings[-1])), 0.0, float(ends["agent"][k]), speed)
            commands.append({"goal": np.float32(goal)})
            sent_ns = round(1e9 * (ends["actuator"][k] + self.acting_s * rng.uniform(0.85, 1.15)))
            acts_ns = max(acts_ns, sent_ns)
            for servo_id, joint_goal, offset in zip(plant.servo_ids, goal, zero, strict=True):
                wanted = round((joint_goal + offset) / hidden.COUNT_RAD) * hidden.COUNT_RAD
                clock.schedule(acts_ns, 0, servo_id, OperatingMode.POSITION, wanted)
        truth.close()
        if path != Path(os.devnull):
            hidden.write_log(path, self.pipeline, (starts, ends), readings, commands, robot.units)
        return np.array(angles)


def trained(robot: Any, bundle: Any, aim: np.ndarray) -> Policy:
    """Return a trained policy, as the robot runs it."""
    agent, runner = robot.agent.make(robot.rate_hz), bundle.runner()
    rest = np.asarray(robot.drive.servos.at_rest, np.float32)
    past = np.zeros((robot.agent.history, 3 * len(rest)), np.float32)
    step = StepState(params=AgentParams(aim=np.float32(aim), start=rest), state=AgentState(rest, past))

    def act(k: int, goal: np.ndarray, reading: JointReading) -> np.ndarray:
        nonlocal step
        del k, goal
        step = step.replace(inputs={robot.roles.sensor: [SimpleNamespace(data=reading)]})
        step, decision = agent.act(step, runner.act(agent.observe(step)))
        return decision.goal

    return act


class ReachingSO101(ReachingArm):
    """The SO-101, with its payload between its jaws."""

    pipeline = "so101"
    links_kg = 0.485
    defaults: ClassVar[dict[str, float]] = {
        "record_s": 40.0, "seconds": 16.0, "episodes": 2, "generations": 40, "steps": 2_000_000, "envs": 256
    }  # fmt: skip

    @classmethod
    def servos(cls, rng: np.random.Generator) -> dict[str, Any]:
        """Draw the servos' parameters: arguments of the plant."""
        return {"gain": rng.uniform(0.8, 1.2), "friction": rng.uniform(0.8, 1.2)}

    def rubbing(self, factor: float) -> dict[str, Any]:
        """Return the plant's arguments with more friction in all joints."""
        return {**self.plant, "friction": factor * self.plant["friction"]}
