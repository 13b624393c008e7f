"""The SO-101's parts: links, the arm of six servos, and its table.

Lengths, masses, centres of mass, inertias, axes and ranges are those of TheRobotStudio's public description
(SO-ARM100, Simulation/SO101, "new calibration"), in axes that are parallel to the world's while all joints are at 0.
Then each is in the middle of its range: the upper arm upright, forearm and hand level and forward, the jaw half open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sim2real import composer
from sim2real.robots.servo.datasheet import StsSheet
from sim2real.robots.servo.parts import Servo, ServoDriven, Unobserved, rubs_only

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""LeRobot's names, in the order of the servos' ids."""
SHEET = StsSheet(stall=2.94, damping=0.60, armature=0.005, friction=0.06, stribeck_rad_s=0.5)
"""An STS3215 at 12 V: 30 kg cm at standstill, 0.222 s/60 deg without load; LeRobot's P gain of 16.

Friction is a guess, and so is where it wears off. That it does, recordings of real ones show (plant.py). Of an
embedded arm a model without it, identified on fast motions, was up to five times as far off in slow ones.
"""
STEP_S = 0.01 / 3
"""Time step of the physics [s]. At 5 ms an identification of the embedded arm finds rotors 44 % too heavy and a delay
1.8 ms too short, at this step 15 to 28 % and 0.7 to 1.0 ms, at 2.5 ms 5 % and 0.2 ms, in a third more steps.
"""
TIP_M = 0.0981
"""From the wrist's roll joint to between the jaws, along its axis [m]."""

_DOWN, _SWING = (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """A link, and the joint that turns it.

    Attributes:
        at: Where its joint is, from the joint before it; of the first from the base [m].
        axis: The joint's axis.
        mass: [kg].
        com: Centre of mass, from its joint [m].
        inertia: About the centre of mass: xx, yy, zz, xy, xz, yz [1e-6 kg m^2].
    """

    at: tuple[float, float, float]
    axis: tuple[float, float, float]
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]


SHAPES = (
    Shape((0.0388, 0, 0.0624), _DOWN, 0.100, (0.0308, 0, 0.0253), (83.8, 81.0, 24.0, -0.1, -1.2, -0.2)),
    Shape((0.0304, 0, 0.0542), _SWING, 0.103, (0.0084, 0.0001, 0.0898), (147.3, 142.5, 40.8, 0, -19.8, 0)),
    Shape((0.0280, 0, 0.1126), _SWING, 0.104, (0.0981, 0, 0.0032), (28.7, 145.3, 159.8, -1.3, -7.4, 0)),
    Shape((0.1349, 0, 0.0052), _SWING, 0.079, (0.0386, 0.0098, 0.0001), (25.4, 21.0, 36.8, -3.6, 0, 0.1)),
    Shape((0.0611, 0, 0), (-1.0, 0.0, 0.0), 0.087, (0.0252, 0.0004, 0.0002), (34.5, 43.4, 27.5, -0.2, 5.7, 0.4)),
    Shape((0.0234, 0.0178, 0.0211), (0, -1, 0), 0.012, (0.0224, -0.0202, 0.0191), (3.9, 5.3, 4.6, 0, -2.4, 0)),
)
"""The links, in the order of the joints."""

TRAVEL_RAD = {"shoulder_pan": 3.84, "shoulder_lift": 3.49, "elbow_flex": 3.38, "wrist_flex": 3.32, "gripper": 1.92}
"""From stop to stop [rad]. The wrist's roll is not among them: LeRobot gives it a whole turn."""


class Link(composer.Entity):
    """A rigid link."""

    def _build(self, name: str, shape: Shape, end: tuple[float, float, float]) -> None:
        self.mjcf_model.model = name
        body = self.mjcf_model.worldbody.add("body", name="link")
        inertia = [1e-6 * i for i in shape.inertia]
        body.add("inertial", pos=shape.com, mass=shape.mass, fullinertia=inertia)
        look = {"contype": 0, "conaffinity": 0, "mass": 0.0, "rgba": (0.95, 0.75, 0.2, 1.0)}
        if math.hypot(*end) > 0:
            body.add("geom", name="rod", type="capsule", fromto=(0, 0, 0, *end), size=[0.012], **look)
        self.end = body.add("site", name="end", pos=end)


class Arm(ServoDriven):
    """Six servos and their links; between its goals' bounds it stays above the table."""

    low, high = (-1.4, -1.65, 0.2, -1.6, -1.5, -0.8), (1.4, -0.3, 1.6, -1.0, 1.5, 0.8)

    def _build(self, name: str = "so101") -> None:
        self.mjcf_model.model = name
        place: Any = self.mjcf_model.worldbody.add("site", name="base", pos=SHAPES[0].at)
        self.servos = tuple(Servo(j, s.axis, SHEET) for j, s in zip(JOINTS, SHAPES, strict=True))
        ends = [s.at for s in SHAPES[1:]] + [(0.0, 0.0, 0.0)]
        for servo, joint, shape, end in zip(self.servos, JOINTS, SHAPES, ends, strict=True):
            self.attach(servo, place)
            link = Link(f"{joint}_link", shape, end)
            servo.attach(link, servo.horn)
            place = link.end
            if joint == "wrist_roll":
                self.tip = link.mjcf_model.worldbody.body["link"].add("site", name="tip", pos=(TIP_M, 0, 0))


class Table(Unobserved, composer.Arena):
    """A table, a target, and how far the jaws shall be open there."""

    def _build(self, name: str = "table") -> None:
        super()._build(name=name)
        rubs_only(self.mjcf_model)
        look = {"contype": 0, "conaffinity": 0}
        world = self.mjcf_model.worldbody
        world.add("geom", name="top", type="plane", size=[0.6, 0.6, 0.05], rgba=[0.8, 0.82, 0.85, 1], **look)
        self.target = world.add("site", name="target", pos=[0.2, 0, 0.2], size=[0.012], rgba=[0.85, 0.3, 0.2, 1])
        self.opening = world.add("site", name="opening")  # x holds the jaw's angle [rad]

    @composer.observable
    def target_position(self, physics: Any) -> Any:
        """Return where the target is ``(3,)`` [m]."""
        return physics.bind(self.target).xpos

    @composer.observable
    def target_opening(self, physics: Any) -> Any:
        """Return how far the jaws shall be open there, ``(1,)`` [rad]."""
        return physics.bind(self.opening).pos[:1]
