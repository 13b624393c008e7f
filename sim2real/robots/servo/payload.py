"""The payload of a robot of servos: an optional term of its model, and part of each drift test."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sim2real.arrays import namespace
from sim2real.identify.parameters import Parameter
from sim2real.robots.servo.parts import GoalTask
from sim2real.types import MjSpec, PyTree, Scalar

mj: Any = mujoco

PAYLOAD = "payload"
"""Name of the parameter, and of its term."""
_MASS, _CENTRE = "mass of the hand", "centre of the hand"


@dataclass(frozen=True)
class Hand:
    """The hand of a robot.

    The payload's inertia about its centre is neglected: the rotors' inertia behind gears is far larger.

    Attributes:
        at_m: Position of a payload in the frame of the link that this joint moves [m].
        most_kg: Largest mass that it can bear [kg].
        least_kg: Smallest change since the identification [kg], a negative number; the link that the
            joint moves weighs more.
    """

    joint: str
    at_m: tuple[float, float, float]
    most_kg: float
    least_kg: float = 0.0

    def parameter(self) -> Parameter:
        """Return the payload: 0 without the optional term, as a gain and a mass are hard to separate."""
        about = "mass in the hand, beyond that of the model"
        return Parameter(
            PAYLOAD, "kg", 0.0, self.least_kg, self.most_kg, "linear", about=about, free=False, term=PAYLOAD, off=0.0
        )

    def body(self, task: GoalTask) -> PyTree:
        """Return the hand's link in a composed task."""
        return next(servo for servo in task.robot.servos if servo.mjcf_model.model == self.joint).horn.parent

    def fields(self, task: GoalTask) -> dict[str, tuple[Any, str]]:
        """Return the parts of a composed model that the payload sets: name -> (elements, attribute)."""
        link = [self.body(task)]
        return {_MASS: (link, "mass"), _CENTRE: (link, "ipos")}

    def loaded(self, mjcf: str, task: GoalTask, values: Mapping[str, Scalar]) -> str:
        """Return a model's MJCF with the payload."""
        spec: MjSpec = mj.MjSpec.from_string(mjcf)
        model, body = spec.compile(), spec.body(self.body(task).full_identifier)
        link = model.body(body.name)
        placed = self.place(values, {_MASS: link.mass, _CENTRE: link.ipos[None]})
        body.explicitinertial, body.mass, body.ipos = True, float(placed[_MASS][0]), np.asarray(placed[_CENTRE][0])
        body.iquat, body.inertia = link.iquat, link.inertia
        body.fullinertia = np.full(6, np.nan)
        spec.compile()
        return spec.to_xml()

    def place(self, values: Mapping[str, Scalar], empty: Mapping[str, PyTree]) -> dict[str, PyTree]:
        """Return the arrays of ``fields``.

        Args:
            values: Parameters by name; without a payload, it is 0.
            empty: The arrays of ``fields`` of an empty hand.
        """
        numbers = values.get(PAYLOAD, 0.0), empty[_MASS], empty[_CENTRE], self.at_m
        xp = namespace(*numbers[:3])
        payload, mass, centre, at_m = (xp.asarray(number, np.float32) for number in numbers)
        payload = payload[..., None]  # of the one link
        total = mass + payload
        return {_MASS: total, _CENTRE: (mass[..., None] * centre + payload[..., None] * at_m) / total[..., None]}
