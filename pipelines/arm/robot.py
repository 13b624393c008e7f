"""The arm for the stages: its servos, its aim, its observation, its parts and its score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.arrays import namespace
from sim2real.later import jax, jnp
from sim2real.robots.messages import JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.robot import Robot
from sim2real.robots.servo import parameters
from sim2real.robots.servo.drive import JointSensor, ServoDrive
from sim2real.robots.servo.model import ComposedModel
from sim2real.robots.servo.observation import ServoAgent
from sim2real.robots.servo.payload import Hand
from sim2real.robots.servo.servos import Servos
from sim2real.robots.servo.task import Aim, AimTask, uniform
from sim2real.robots.session import Embedded
from sim2real.types import Array, Key

from .parts import JOINTS, LINK_M, SHEET, Arm
from .task import CLOSE_M, HIGH, LOW, Reach, tip_of

SERVOS = Servos(joints=JOINTS, ids=(1, 2, 3), low=Arm.low, high=Arm.high, sheet=SHEET, speed=2.0)
HAND = Hand("elbow", (0.0, 0.0, -LINK_M), most_kg=0.3, least_kg=-0.044)  # the tip; the link has 55 g


def embedded() -> Embedded:
    """Return the emulated arm, with latencies that no stage reads."""
    from sim2real.emulation.dynamixel import EmulatorConfig

    emulator = EmulatorConfig(
        sensing_latency_s=0.006,
        sensing_jitter_s=0.001,
        actuation_latency_s=0.014,
        actuation_jitter_s=0.002,
        reply_loss=0.001,
    )
    return Embedded(f"{Path(__file__).with_name('plant.py')}:ArmPlant", emulator)


def draw_target(key: Key | int) -> Array:
    """Return a target ``(3,)`` [m]."""
    angles = uniform(key, LOW, HIGH)
    return tip_of(namespace(angles), angles)


TARGET = Aim(
    entries=(("target x", "m"), ("target y", "m"), ("target z", "m")),
    draw=draw_target,
    elements=lambda task: {"target": (task.gantry.target, "pos")},
    place=lambda aim: {"target": jnp.asarray(aim, jnp.float32)},
)

FEATURES = (
    ("position", ("rad",) * 3, 5.0),
    ("velocity / 5", ("rad/s",) * 3, 6.0),
    ("goal less position", ("rad",) * 3, 6.0),
    ("10 x target less tip: outwards, sideways, up", ("m",) * 3, 10.0),
)


def observe(reading: JointReading, goal: Array, aim: Array) -> Array:
    """Return ``FEATURES``: the joints, and the way to the target in the frame of the arm."""
    q, xp = reading.position, namespace(reading.position, goal)
    gap = aim - tip_of(xp, q)
    c, s = xp.cos(q[0]), xp.sin(q[0])
    way = xp.stack([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0], gap[2]])
    return xp.concatenate([q, reading.velocity / 5.0, goal - q, 10.0 * way])


def success(state: Any) -> jax.Array:
    """Return whether the tip is at the target."""
    return state.variables["distance"] < CLOSE_M


def score(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return how near the tip came to the target.

    ``success`` is the share of the second half with the tip within 2 cm; ``reached`` is 1 if it is there at the end.
    """
    position = np.stack([states[f"position[{i}]"] for i in range(3)], axis=-1)
    target = np.array([states[f"aim[{i}]"][-1] for i in range(3)])
    distance = np.linalg.norm(tip_of(np, position) - target, axis=-1)
    second_half, end = t_s >= (t_s[0] + t_s[-1]) / 2, t_s >= t_s[-1] - 0.5
    there = np.flatnonzero(distance < CLOSE_M)
    return {
        "success": float((distance[second_half] < CLOSE_M).mean()),
        "reached": float(distance[end].mean() < CLOSE_M),
        "distance_m": float(distance[end].mean()),
        "first_reached_s": float(t_s[there[0]] - t_s[0]) if there.size else float("nan"),
    }


class ArmRobot(Robot):
    """A three-joint arm that hangs from a gantry."""

    def __init__(self, servos: Servos = SERVOS) -> None:
        self.sensor = JointSensor(servos)
        self.drive = ServoDrive(servos, probe=Probe(step=0.12, lag_s=0.0115), embedded=embedded)
        self.agent = ServoAgent(servos, TARGET, FEATURES, observe)
        self.model = ComposedModel(servos, self.make_task, TARGET, HAND, causes=parameters.causes(JOINTS))
        self.task = AimTask(servos, TARGET, success, score)

    def make_task(self) -> Reach:
        """Return the task; the graph's parameters set the target."""
        return Reach(draw_target=False)


ROBOT = ArmRobot()
