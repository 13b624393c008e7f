"""Dry friction that wears off with speed, of the joints of a MuJoCo model (Stribeck effect)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sim2real.types import Array, PyTree, Scalar
from sim2real.worlds.rollouts import StepLaw


class WornFriction(StepLaw):
    """Sets dry friction before every step: ``frictionloss * exp(-|velocity| / stribeck_rad_s)``.

    What MuJoCo's constraint holds at standstill stays exact; only how large it is follows the speed.
    """

    fields: tuple[str, ...] = ("dof_frictionloss",)
    """Field of the model that it sets, ``(nv,)``."""

    def __call__(
        self, xp: Any, values: Mapping[str, Scalar], control: Array, qpos: Array, qvel: Array
    ) -> tuple[Any, Any, dict[str, PyTree]]:
        """Return controls ``(..., nu)`` as they are, forces of 0 ``(..., nv)``, and the friction of the next step.

        Args:
            values: ``frictionloss`` at standstill [N m] and ``stribeck_rad_s``, where 1/e of it is left, ``(..., nv)``.
            control: Controls ``(..., nu)``.
            qvel: Velocities ``(..., nv)`` [rad/s].
        """
        del qpos
        left = xp.exp(-xp.abs(qvel) / values["stribeck_rad_s"])
        return control, 0.0 * qvel, {"dof_frictionloss": values["frictionloss"] * left}
