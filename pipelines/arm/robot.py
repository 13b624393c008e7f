"""The arm for the stages: its servos, its aim, its observation, its reward and its score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.arrays import namespace
from sim2real.later import jax, jnp
from sim2real.robots.messages import JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.robot import Embedded, Robot
from sim2real.robots.servo.model import Hand, ServoModel
from sim2real.robots.servo.servos import DataSheet, ServoDrive, Servos
from sim2real.robots.servo.task import Aim, AimTask, ServoMoment, uniform
from sim2real.types import Array, Key

SERVOS = Servos(
    joints=("pan", "shoulder", "elbow"),
    ids=(1, 2, 3),
    low=(-1.4, -1.4, -1.6),
    high=(1.4, 1.4, 1.6),
    sheet=DataSheet(stall=1.4, damping=0.23, armature=0.0045, friction=0.03, p_gain=800, profile_rad_s=5.0),
    speed=2.0,
)
"""XL430-W250 at 12 V."""
MJCF = Path(__file__).with_name("arm.xml")
GANTRY_M, SHOULDER_M, LINK_M = 0.40, (0.04, -0.03), 0.12
"""Height of the pan axis over the table; where the shoulder sits in front of it and below; each link [m]."""
HAND = Hand("elbow", (0.0, 0.0, -LINK_M), most_kg=0.3, least_kg=-0.044)  # the tip; the link has 55 g
CLOSE_M = 0.02
"""How near the tip must come [m]."""
LOW, HIGH = (-1.2, -0.3, -0.2), (1.2, 1.2, 1.4)
"""Joint angles between which targets are drawn [rad]: every target can be reached."""
FEATURES = (
    ("position", ("rad",) * 3, 5.0),
    ("velocity / 5", ("rad/s",) * 3, 6.0),
    ("goal less position", ("rad",) * 3, 6.0),
    ("10 x target less tip: outwards, sideways, up", ("m",) * 3, 10.0),
)


def embedded() -> Embedded:
    """Return the emulated arm, with latencies that no stage reads."""
    from sim2real.emulation.dynamixel import EmulatorConfig

    from .plant import ArmPlant

    emulator = EmulatorConfig(
        sensing_latency_s=0.006,
        sensing_jitter_s=0.001,
        actuation_latency_s=0.014,
        actuation_jitter_s=0.002,
        reply_loss=0.001,
    )
    return Embedded(ArmPlant, emulator)


def tip_of(position: Array) -> Any:
    """Return where the tip is ``(..., 3)`` [m] for joint angles ``(..., 3)`` [rad]; all 0: straight down."""
    xp = namespace(position)
    pan, upper = position[..., 0], position[..., 1]
    fore = upper + position[..., 2]
    out = SHOULDER_M[0] + LINK_M * (xp.sin(upper) + xp.sin(fore))
    height = GANTRY_M + SHOULDER_M[1] - LINK_M * (xp.cos(upper) + xp.cos(fore))
    return xp.stack([out * xp.cos(pan), out * xp.sin(pan), height], axis=-1)


def draw_target(key: Key | int) -> Array:
    """Return a target ``(3,)`` [m]."""
    return tip_of(uniform(key, LOW, HIGH))


TARGET = Aim((("target x", "m"), ("target y", "m"), ("target z", "m")), draw_target)


def way(position: Array, gap: Array) -> Any:
    """Return a distance ``(3,)`` [m] in the frame of the arm at joint angles ``(3,)`` [rad]."""
    xp = namespace(position, gap)
    c, s = xp.cos(position[0]), xp.sin(position[0])
    return xp.stack([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0], gap[2]])


def observe(reading: JointReading, goal: Array, aim: Array) -> Array:
    """Return ``FEATURES``: the joints, and the way to the target in the frame of the arm."""
    q, xp = reading.position, namespace(reading.position, goal)
    return xp.concatenate([q, reading.velocity / 5.0, goal - q, 10.0 * way(q, aim - tip_of(q))])


def distance_m(now: ServoMoment) -> jax.Array:
    """Return how far the tip is from the target [m]."""
    # The square root has no derivative at 0.
    return jnp.sqrt(jnp.sum((tip_of(now.position) - now.aim) ** 2) + 1e-12)


def reward(now: ServoMoment) -> jax.Array:
    """Return up to 2 at the target, less than 0 far away."""
    distance = distance_m(now)
    return jnp.exp(-((distance / 0.1) ** 2)) + jnp.exp(-((distance / CLOSE_M) ** 2)) - 2.0 * distance


def success(now: ServoMoment) -> jax.Array:
    """Return whether the tip is at the target."""
    return distance_m(now) < CLOSE_M


def score(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return how near the tip came to the target.

    ``success`` is the share of the second half with the tip within 2 cm; ``reached`` is 1 if it is there at the end.
    """
    position = np.stack([states[f"position[{i}]"] for i in range(3)], axis=-1)
    target = np.array([states[f"aim[{i}]"][-1] for i in range(3)])
    distance = np.linalg.norm(tip_of(position) - target, axis=-1)
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
        self.drive = ServoDrive(servos, probe=Probe(step=0.12, lag_s=(0.008, 0.0115)), embedded=embedded)
        self.model = ServoModel(servos, MJCF, HAND)
        self.task = AimTask(servos, TARGET, reward, success, score, FEATURES, observe)


ROBOT = ArmRobot()
