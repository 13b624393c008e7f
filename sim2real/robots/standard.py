"""The parameters of a robot whose servos are all of one model: shared ones, and the friction of each joint.

They are a servo's, at its shaft, as in its data sheet. A joint with a gear feels torque and friction times the gear,
and gain, damping and inertia times its square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.composer.models.translate import mj
from sim2real.hardware.joint import Joint
from sim2real.identify.parameters import Parameter
from sim2real.robots.datasheet import DataSheet
from sim2real.robots.parts import ServoDriven


def parameters(sheet: DataSheet, joints: Sequence[Joint | str]) -> list[Parameter]:
    """Return gain, damping, rotor inertia and each joint's friction, bounded to factors of 3 to 8 of the data sheet."""
    s = sheet
    return [
        Parameter("gain", "N m/rad", s.gain, s.gain / 3, s.gain * 3, about="torque per error, at the P gain in use"),
        Parameter("damping", "N m s/rad", s.damping, s.damping / 4, s.damping * 4, about="back-EMF, viscous friction"),
        Parameter("armature", "kg m^2", s.armature, s.armature / 4, s.armature * 4, about="rotor behind the gears"),
        *(
            Parameter(f"friction_{j.name}", "N m", s.friction, s.friction / 8, s.friction * 8, about="dry friction")
            for j in map(Joint.of, joints)
        ),
    ]


def fields(robot: ServoDriven) -> dict[str, tuple[Any, str]]:
    """Return the parts of a composed model that the parameters set: name -> (elements, attribute)."""
    return {
        "gain": (robot.actuators, "gainprm"),
        "bias": (robot.actuators, "biasprm"),
        "most": (robot.actuators, "forcerange"),
        "damping": (robot.joints, "damping"),
        "armature": (robot.joints, "armature"),
        "friction": (robot.joints, "frictionloss"),
    }


def place(values: Mapping[str, Any], sheet: DataSheet, joints: Sequence[Joint | str], step_s: float) -> dict[str, Any]:
    """Return the arrays of ``fields`` for parameters by name.

    Args:
        values: Parameters by name.
        sheet: The servo's data sheet.
        joints: The joints, or their names.
        step_s: The physics' time step [s].
    """
    joints = [Joint.of(joint) for joint in joints]
    n, gear = len(joints), np.array([joint.gear for joint in joints], np.float32)
    gain, damping = (jnp.asarray(values[name], jnp.float32) for name in ("gain", "damping"))
    # MuJoCo's implicit integration of damping acts like an additional inertia of half a step times the damping, which
    # is subtracted here. At 2.5 ms it is 6 % of the rotors' inertia of pipelines/arm.
    armature = jnp.maximum(jnp.asarray(values["armature"]) - 0.5 * step_s * damping, 0.0)
    return {
        "gain": jnp.zeros((n, 10)).at[:, 0].set(gain * gear**2),
        "bias": jnp.zeros((n, 10)).at[:, 1].set(-gain * gear**2),
        # The torque limit is that at full duty, so it is proportional to the gain.
        "most": gain * sheet.full_rad * gear[:, None] * jnp.tile(jnp.array([[-1.0, 1.0]]), (n, 1)),
        "damping": damping * gear**2,
        "armature": armature * gear**2,
        "friction": gear * jnp.stack([jnp.asarray(values[f"friction_{j.name}"], jnp.float32) for j in joints]),
    }


def identified_mjcf(
    mjcf: str, robot: ServoDriven, values: Mapping[str, Any], sheet: DataSheet, joints: Sequence[Joint | str]
) -> str:
    """Return a model's MJCF with given parameters, for use in other tools.

    Args:
        mjcf: The composed model.
        robot: The robot in it.
        values: Parameters by name.
        sheet: The servo's data sheet.
        joints: The joints, or their names.
    """
    spec: Any = mj.MjSpec.from_string(mjcf)
    for mounted, element, actuator in zip(map(Joint.of, joints), robot.joints, robot.actuators, strict=True):
        gear = mounted.gear
        gain, friction = float(values["gain"]) * gear**2, float(values[f"friction_{mounted.name}"]) * gear
        joint, motor = spec.joint(element.full_identifier), spec.actuator(actuator.full_identifier)
        joint.damping = [float(values["damping"]) * gear**2, *joint.damping[1:]]
        joint.armature, joint.frictionloss = float(values["armature"]) * gear**2, friction
        motor.gainprm, motor.biasprm = [gain, *motor.gainprm[1:]], [0.0, -gain, *motor.biasprm[2:]]
        most = gain * sheet.full_rad / gear
        motor.forcerange = [-most, most]
    spec.compile()
    return spec.to_xml()
