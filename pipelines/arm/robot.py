"""The arm for the stages: its servos, what is identified, its aim and its score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import namespace
from sim2real.graph.base import Array
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.robots.control_loop.hardware import Embedded
from sim2real.robots.control_loop.messages import JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.servo import parameters
from sim2real.robots.servo.payload import Hand
from sim2real.robots.servo.servo_robot import ServoRobot, Servos

from .parts import JOINTS, LINK_M, SHEET, Arm
from .task import CLOSE_M, HIGH, LOW, Reach, tip_of


class ArmRobot(ServoRobot):
    """A three-joint arm that hangs from a gantry."""

    servos = Servos(
        joints=JOINTS,
        ids=(1, 2, 3),
        low=Arm.low,
        high=Arm.high,
        sheet=SHEET,
        speed=2.0,
    )
    probe = Probe(step=0.12, lag_s=0.0115)
    causes = parameters.causes(JOINTS)
    hand = Hand("elbow", (0.0, 0.0, -LINK_M), most_kg=0.3, least_kg=-0.044)  # the tip; the link has 55 g
    aim = (("target x", "m"), ("target y", "m"), ("target z", "m"))
    features = (
        ("position", ("rad",) * 3, 5.0),
        ("velocity / 5", ("rad/s",) * 3, 6.0),
        ("goal less position", ("rad",) * 3, 6.0),
        ("10 x target less tip: outwards, sideways, up", ("m",) * 3, 10.0),
    )

    @property
    def embedded(self) -> Embedded:
        """The robot inside the computer, with latencies that no stage is told."""
        plant = f"{Path(__file__).with_name('plant.py')}:ArmPlant"
        emulator = EmulatorConfig(
            sensing_latency_s=0.006,
            sensing_jitter_s=0.001,
            actuation_latency_s=0.014,
            actuation_jitter_s=0.002,
            reply_loss=0.001,
        )
        return Embedded(plant, emulator)

    def make_task(self) -> Reach:
        """Return the task; where the target is, the graph's parameters say."""
        return Reach(draw_target=False)

    def aim_fields(self, task: Reach) -> Mapping[str, tuple[Any, str]]:
        """Return where the target stands in the model."""
        return {"target": (task.gantry.target, "pos")}

    def place_aim(self, aim: Any) -> dict[str, Any]:
        """Return the target's position ``(3,)`` [m]."""
        return {"target": jnp.asarray(aim, jnp.float32)}

    def draw_aim(self, key: jax.Array) -> jax.Array:
        """Return a target ``(3,)`` [m]."""
        return tip_of(jnp, jax.random.uniform(key, (3,), minval=jnp.array(LOW), maxval=jnp.array(HIGH)))

    def observe(self, reading: JointReading, goal: Any, aim: Any) -> Array:
        """Return what the policy sees: joints, and the way to the target, seen from the arm."""
        q, xp = reading.position, namespace(reading.position, goal)
        gap = aim - tip_of(xp, q)
        c, s = xp.cos(q[0]), xp.sin(q[0])
        way = xp.stack([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0], gap[2]])
        return xp.concatenate([q, reading.velocity / 5.0, goal - q, 10.0 * way])

    def success(self, state: Any) -> jax.Array:
        """Return whether the tip is at the target."""
        return state.variables["distance"] < CLOSE_M

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how near the tip came.

        ``success`` is the share of the second half spent within 2 cm, ``reached`` 1 where the tip is there at the end.
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


ROBOT = ArmRobot()
