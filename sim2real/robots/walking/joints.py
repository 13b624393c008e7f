"""What the joints of a walking robot differ by: damping, friction and armature of a group, strength of each motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.identification.parameters import Parameter
from sim2real.types import Array, PyTree, Scalar

QUANTITIES = {
    "damping": ("N m s/rad", 0.1, 0.002, 2.0, "viscous friction of a joint"),
    "friction": ("N m", 0.2, 0.005, 2.0, "dry friction of a joint"),
    "armature": ("kg m^2", 0.01, 0.0005, 0.1, "rotor behind the gears"),
}
"""Quantity of a group of joints -> unit, nominal value, bounds, description."""
STRENGTH = "strength"
ZERO_RAD = 0.015
"""Deviation of the prior of an encoder's zero [rad]."""


@dataclass(frozen=True)
class JointParameters:
    """Names of the parameters of joints, and their places.

    Attributes:
        motors: Names of the joints, in the order of the motors.
        groups: Name of a group -> numbers of its joints, which have one damping, friction and armature.
    """

    motors: tuple[str, ...]
    groups: Mapping[str, Sequence[int]]

    def dynamics(self) -> list[Parameter]:
        """Return damping, friction and armature of each group, and the strength of each motor."""
        rows = [
            Parameter(f"{group}_{name}", unit, nominal, low, high, about=about, vanishes=name != "armature")
            for group in self.groups
            for name, (unit, nominal, low, high, about) in QUANTITIES.items()
        ]
        about = "factor on the motor's torque"
        return rows + [Parameter(f"{m}_{STRENGTH}", "1", 1.0, 0.4, 2.0, about=about) for m in self.motors]

    def zeros(self) -> list[Parameter]:
        """Return the encoders' zeros; legs in the air weigh little, so their zeros change a log little."""
        import distrax

        prior, about = distrax.Normal(0.0, ZERO_RAD), "encoder at the model's zero"
        return [
            Parameter(f"{m}_zero", "rad", 0.0, -0.1, 0.1, "linear", "measurement", about, prior=prior)
            for m in self.motors
        ]

    def of_group(self, values: Mapping[str, Scalar], quantity: str, xp: PyTree = np) -> Array:
        """Return a quantity of all joints, ``(joints,)``."""
        each = {i: values[f"{group}_{quantity}"] for group, at in self.groups.items() for i in at}
        return xp.stack([xp.asarray(each[i], dtype=float) for i in range(len(self.motors))])

    def of_motor(self, values: Mapping[str, Scalar], quantity: str, xp: PyTree = np) -> Array:
        """Return a quantity that each motor has of its own, ``(joints,)``."""
        return xp.stack([xp.asarray(values[f"{motor}_{quantity}"], dtype=float) for motor in self.motors])
