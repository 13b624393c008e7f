"""What a robot of servos holds in its hand: an optional term of its model, and tested for after each deployment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.composer.models.mjcf.translate import mj
from sim2real.identify.parameters import Parameter
from sim2real.robots.servo.parts import GoalTask

PAYLOAD = "payload"
"""Name of the parameter, and of its term."""
_MASS, _CENTRE = "mass of the hand", "centre of the hand"


@dataclass(frozen=True)
class Hand:
    """Where a robot holds things.

    Its inertia about its own centre is omitted: behind gears the rotors' is larger by far.

    Attributes:
        joint: The joint that moves the hand.
        at_m: Where a payload is in the frame of the link that this joint moves [m].
        most_kg: What it can bear.
        least_kg: What it may hold less than when the robot was identified, as a negative number; the link that the
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

    def body(self, task: GoalTask) -> Any:
        """Return the link in a composed task that holds things."""
        return next(servo for servo in task.robot.servos if servo.mjcf_model.model == self.joint).horn.parent

    def fields(self, task: GoalTask) -> dict[str, tuple[Any, str]]:
        """Return the parts of a composed model that the payload sets: name -> (elements, attribute)."""
        link = [self.body(task)]
        return {_MASS: (link, "mass"), _CENTRE: (link, "ipos")}

    def loaded(self, mjcf: str, task: GoalTask, values: Mapping[str, Any]) -> str:
        """Return a model's MJCF with what the hand holds.

        Args:
            task: Of which it is the model.
        """
        spec: Any = mj.MjSpec.from_string(mjcf)
        model, body = spec.compile(), spec.body(self.body(task).full_identifier)
        own = model.body(body.name)
        placed = self.place(values, {_MASS: own.mass, _CENTRE: own.ipos[None]})
        body.explicitinertial, body.mass, body.ipos = True, float(placed[_MASS][0]), np.asarray(placed[_CENTRE][0])
        body.iquat, body.inertia = own.iquat, own.inertia
        body.fullinertia = np.full(6, np.nan)
        spec.compile()
        return spec.to_xml()

    def place(self, values: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arrays of ``fields``.

        Args:
            values: Parameters by name; without a payload among them there is none.
            own: The arrays of ``fields`` of a hand that holds nothing.
        """
        carried = jnp.asarray(values.get(PAYLOAD, 0.0), jnp.float32)
        mass, centre = own[_MASS], own[_CENTRE]
        total = mass + carried
        return {_MASS: total, _CENTRE: (mass * centre + carried * jnp.asarray(self.at_m)) / total}
