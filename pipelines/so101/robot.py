"""The SO-101 for the stages: its servos and their calibration, its aim, its observation, its reward and its score."""

from __future__ import annotations

import os
import random
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.identification.parameters import Parameter
from sim2real.later import jax, jnp
from sim2real.robots.messages import JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.robot import Embedded, Robot
from sim2real.robots.servo.model import Hand, ServoModel, goal_offsets, servo_parameters
from sim2real.robots.servo.servos import ServoDrive, Servos, StsSheet
from sim2real.robots.servo.task import Aim, AimTask, ServoMoment, uniform
from sim2real.types import Array, Key

if TYPE_CHECKING:
    from sim2real.hardware.bus.servos import PositionDrive, ServoJoint

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""LeRobot's names, in the order of the servos' ids."""
SHEET = StsSheet(stall=2.94, damping=0.60, armature=0.005, friction=0.06, stribeck_rad_s=0.5)
"""An STS3215 at 12 V: 30 kg cm at standstill, 0.222 s/60 deg without load; LeRobot's P gain of 16.

Friction is a guess, and so is where it wears off. That it does, recordings of real ones show (plant.py). Of an
embedded arm a model without it, identified on fast motions, was up to five times as far off in slow ones.
"""
MJCF = Path(__file__).with_name("so101.xml")
STEP_S = 0.01 / 3
"""Time step of the physics [s]. At 5 ms an identification of the embedded arm finds rotors 44 % too heavy and a delay
1.8 ms too short, at this step 15 to 28 % and 0.7 to 1.0 ms, at 2.5 ms 5 % and 0.2 ms, in a third more steps.
"""
BASE_M, TIP_M = (0.0388, 0.0624 + 0.0542), 0.0981
"""The shoulder's pan axis and the height of its lift axis over the table; the point between the jaws from the wrist's
roll joint, along its axis [m]."""
LINKS_M = ((0.0280, 0.1126), (0.1349, 0.0052), (0.0611 + TIP_M, 0.0))
"""Upper arm, forearm and hand in so101.xml: forwards and up from joint to joint [m]."""
LIFT_M = 0.0304
"""The lift axis in front of the pan axis [m]."""
TRAVEL_RAD = {"shoulder_pan": 3.84, "shoulder_lift": 3.49, "elbow_flex": 3.38, "wrist_flex": 3.32, "gripper": 1.92}
"""From stop to stop [rad]. The wrist's roll is not among them: LeRobot gives it a whole turn."""
CLOSE_M, CLOSE_RAD = 0.02, 0.1
"""How near tip and jaw must come [m], [rad]."""
SERVOS = Servos(
    joints=JOINTS,
    ids=(1, 2, 3, 4, 5, 6),
    low=(-1.4, -1.65, 0.2, -1.6, -1.5, -0.8),
    high=(1.4, -0.3, 1.6, -1.0, 1.5, 0.8),
    sheet=SHEET,
    speed=1.5,
    rest=(0.0, -1.65, 1.6, -1.4, 0.0, -0.6),
    middle=(0.0, -0.95, 0.9, -1.3, 0.0, 0.0),
    device="feetech",
)
SATURATES = ("wrist_roll", "gripper")
"""Joints whose servos may push no harder from a smaller error on than the others: each has a limit of its own."""
HAND = Hand("wrist_roll", (TIP_M, 0.0, 0.0), most_kg=0.5, least_kg=-0.07)
"""Between the jaws; the link has 87 g."""
LOW, HIGH = (-0.8, -1.3, 0.5, -1.5, -1.0, -0.5), (0.8, -0.4, 1.4, -1.1, 1.0, 0.5)
"""Joint angles between which targets are drawn [rad]: the arm can reach all of them."""
FEATURES = (
    ("position", ("rad",) * 6, 5.0),
    ("velocity / 5", ("rad/s",) * 6, 5.0),
    ("goal less position", ("rad",) * 6, 6.0),
    ("10 x target less tip: outwards, sideways, up", ("m",) * 3, 10.0),
    ("opening less the jaw's", ("rad",), 6.0),
)
CALIBRATION = "SO101_CALIBRATION"
"""Environment variable that names the calibration of the arm on the port."""


class SO101Robot(Robot):
    """An SO-101 on a table.

    Its goals stay in a box of joint angles that keeps the arm 4 cm above the table. In a corner of the box it is folded
    away: the upper arm lies back on its stop, the forearm above it, the hand points up. It stays there without torque.
    From any other pose it sinks to the table when it loses its torque.

    Args:
        calibration: The calibration of the arm on a port; None: the file that `find` returns.
    """

    def __init__(self, servos: Servos = SERVOS, calibration: Path | None = None) -> None:
        settings = partial(calibrated, calibration=calibration)
        probe = Probe(step=0.12, lag_s=(-0.009, -0.004))
        self.drive = ServoDrive(servos, probe=probe, embedded=embedded, settings=settings)
        self.model = ServoModel(servos, MJCF, HAND, step_s=STEP_S, dynamics=dynamics)
        self.task = AimTask(servos, TARGET, reward, success, score, FEATURES, observe)


def embedded() -> Embedded:
    """Return the emulated arm, with latencies that no stage reads."""
    from sim2real.emulation.feetech import StsEmulation

    from .plant import SO101Plant

    draw = random.Random("an SO-101 of its own")
    emulator = StsEmulation(
        sensing_latency_s=draw.uniform(0.004, 0.008),
        sensing_jitter_s=draw.uniform(0.0005, 0.001),
        actuation_latency_s=draw.uniform(0.008, 0.016),
        actuation_jitter_s=draw.uniform(0.001, 0.002),
        reply_loss=0.001,
        homing_offset=85,
    )
    return Embedded(SO101Plant, emulator)


def calibrated(embedded: bool, calibration: Path | None = None) -> PositionDrive:
    """Return the servos' settings with the calibration of the arm on a port, or of the embedded one."""
    joints = read(Path(__file__).with_name("calibration.json") if embedded else calibration or find())
    return replace(SHEET.drive, joints=joints)


def dynamics() -> list[Parameter]:
    """Return the parameters: servos of one model, each with its own friction and damping."""
    own = ("damping", "friction", "stribeck")
    of_servos = servo_parameters(SHEET, JOINTS, own=own) + goal_offsets(JOINTS)
    # The jaw has so little friction that no recording shows at which speed it wears off: it keeps it at all speeds. Its
    # mean over the speeds of a recording is near the usual lower bound, 0.0075 N m.
    of_servos = [p for p in of_servos if p.name != "stribeck_gripper"]
    of_servos = [replace(p, low=p.low / 10) if p.name == "friction_gripper" else p for p in of_servos]
    full, about = SHEET.full_rad, "error from which on it pushes no harder"
    limit = Parameter("saturation", "rad", full, full / 10, full * 2, about=about, limits=True)
    # A search that begins at the data sheet's limit, which no motion reaches, often stays there.
    limits = [limit, *(replace(limit, name=f"saturation_{j}", begin=full / 4) for j in SATURATES)]
    return [*of_servos, *limits, HAND.parameter()]


def tip_of(position: Array) -> Any:
    """Return where the point between the jaws is ``(..., 3)`` [m] for joint angles ``(..., 6)`` [rad]."""
    xp = namespace(position)
    pan, pitch = position[..., 0], position[..., 1]
    out, height = LIFT_M, BASE_M[1]
    for joint, (x, z) in enumerate(LINKS_M, 2):
        c, s = xp.cos(pitch), xp.sin(pitch)
        out, height = out + c * x + s * z, height - s * x + c * z
        pitch = pitch + position[..., joint]
    return xp.stack([BASE_M[0] + out * xp.cos(pan), -out * xp.sin(pan), height], axis=-1)


def draw_target(key: Key | int) -> Array:
    """Return a target [m] and an opening [rad], ``(4,)``."""
    angles = uniform(key, LOW, HIGH)
    return namespace(angles).append(tip_of(angles), angles[5])


TARGET = Aim((("target x", "m"), ("target y", "m"), ("target z", "m"), ("opening", "rad")), draw_target)


def way(position: Array, gap: Array) -> Any:
    """Return a distance ``(3,)`` [m] in the frame of the arm at joint angles ``(6,)`` [rad]."""
    xp = namespace(position, gap)
    c, s = xp.cos(position[0]), -xp.sin(position[0])  # pan turns clockwise
    return xp.stack([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0], gap[2]])


def observe(reading: JointReading, goal: Array, aim: Array) -> Array:
    """Return ``FEATURES``: the joints, and the way to the target in the frame of the arm."""
    q, xp = reading.position, namespace(reading.position, goal)
    return xp.concatenate([q, reading.velocity / 5.0, goal - q, 10.0 * way(q, aim[:3] - tip_of(q)), aim[3:] - q[5:]])


def errors(now: ServoMoment) -> tuple[jax.Array, jax.Array]:
    """Return how far the tip is from its target [m], and the jaw from its opening [rad]."""
    gap = tip_of(now.position) - now.aim[:3]
    # The square root has no derivative at 0.
    return jnp.sqrt(jnp.sum(gap**2) + 1e-12), jnp.abs(now.position[5] - now.aim[3])


def reward(now: ServoMoment) -> jax.Array:
    """Return up to 2.5 at the target with the jaw open as commanded, less than 0 far away."""
    distance, ajar = errors(now)
    near, nearer = (jnp.exp(-((distance / size) ** 2)) for size in (0.1, CLOSE_M))
    return near + nearer - 2.0 * distance + 0.5 * jnp.exp(-((ajar / CLOSE_RAD) ** 2)) - 0.3 * ajar


def success(now: ServoMoment) -> jax.Array:
    """Return whether the tip is at the target, and the jaw at its commanded opening."""
    distance, ajar = errors(now)
    return (distance < CLOSE_M) & (ajar < CLOSE_RAD)


def score(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return how near tip and jaw came.

    ``success`` is the share of the second half in which both are there, ``reached`` 1 where they are at the end.
    """
    position = np.stack([states[f"position[{i}]"] for i in range(6)], axis=-1)
    aim = np.array([states[f"aim[{i}]"][-1] for i in range(4)])
    distance = np.linalg.norm(tip_of(position) - aim[:3], axis=-1)
    ajar = np.abs(position[:, 5] - aim[3])
    there = (distance < CLOSE_M) & (ajar < CLOSE_RAD)
    second_half, end = t_s >= (t_s[0] + t_s[-1]) / 2, t_s >= t_s[-1] - 0.5
    first = np.flatnonzero(there)
    return {
        "success": float(there[second_half].mean()),
        "reached": float(distance[end].mean() < CLOSE_M and ajar[end].mean() < CLOSE_RAD),
        "distance_m": float(distance[end].mean()),
        "opening_off_rad": float(ajar[end].mean()),
        "first_reached_s": float(t_s[first[0]] - t_s[0]) if first.size else float("nan"),
    }


def read(path: Path) -> tuple[ServoJoint, ...]:
    """Return the joints of LeRobot's calibration file, in the order of the arm.

    Raises:
        UsageError: It is no calibration of an SO-101, or the range of a joint with stops is far from its travel.
    """
    from sim2real.hardware.calibration import read_calibration

    joints = {joint.name: joint for joint in read_calibration(path, TRAVEL_RAD)}
    if lacking := [name for name in JOINTS if name not in joints]:
        raise UsageError(
            f"calibration file {path} has no motor {lacking[0]!r}. There are: {', '.join(joints)}",
            hint="is it an SO-101's?",
        )
    # The bus is read in the order of the ids: with another order, each joint would get the readings of another one.
    for name, servo_id in zip(JOINTS, SERVOS.ids, strict=True):
        if joints[name].servo_id != servo_id:
            raise UsageError(
                f"calibration file {path}: motor {name!r} has id {joints[name].servo_id}, not {servo_id}",
                hint="lerobot-setup-motors gives each servo its id",
            )
    return tuple(joints[name] for name in JOINTS)


def find() -> Path:
    """Return the calibration of the arm: the file that SO101_CALIBRATION names, otherwise LeRobot's only one.

    Raises:
        UsageError: There is none, or there are several.
    """
    folder, paths = calibrations()
    if len(paths) != 1:
        there = f"several calibrations: {', '.join(path.name for path in paths)}" if paths else "no calibration"
        raise UsageError(
            f"there is {there} in {folder}",
            hint=f"set {CALIBRATION} to the file of this arm; lerobot-calibrate writes one",
        )
    return paths[0]


def calibrations() -> tuple[Path, list[Path]]:
    """Return LeRobot's folder, and its calibrations of SO-101 arms; or the file that SO101_CALIBRATION names alone."""
    if named := os.environ.get(CALIBRATION):
        path = Path(named).expanduser()
        return path.parent, [path]
    home = os.environ.get("HF_LEROBOT_HOME", "~/.cache/huggingface/lerobot")
    folder = Path(os.environ.get("HF_LEROBOT_CALIBRATION", f"{home}/calibration")).expanduser() / "robots"
    return folder, [p for kind in ("so101_follower", "so_follower") for p in sorted((folder / kind).glob("*.json"))]


ROBOT = SO101Robot()
