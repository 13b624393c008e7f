"""The parameters of a robot whose servos are all of one model: shared ones, and the friction of each joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from sim2real.composer.models.translate import mj
from sim2real.identify.parameters import Parameter
from sim2real.robots.datasheet import DataSheet
from sim2real.robots.parts import ServoDriven


def parameters(sheet: DataSheet, joints: Sequence[str]) -> list[Parameter]:
    """Return gain, damping, rotor inertia and each joint's friction, bounded to factors of 3 to 8 of the data sheet."""
    s = sheet
    return [
        Parameter("gain", "N m/rad", s.gain, s.gain / 3, s.gain * 3, about="torque per error, at the P gain in use"),
        Parameter("damping", "N m s/rad", s.damping, s.damping / 4, s.damping * 4, about="back-EMF, viscous friction"),
        Parameter("armature", "kg m^2", s.armature, s.armature / 4, s.armature * 4, about="rotor behind the gears"),
        *(
            Parameter(f"friction_{j}", "N m", s.friction, s.friction / 8, s.friction * 8, about="dry friction")
            for j in joints
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


def place(values: Mapping[str, Any], sheet: DataSheet, joints: Sequence[str], step_s: float) -> dict[str, Any]:
    """Return the arrays of ``fields`` for parameters by name.

    Args:
        values: Parameters by name.
        sheet: The servo's data sheet.
        joints: Names of the joints.
        step_s: The physics' time step [s].
    """
    n = len(joints)
    gain, damping = (jnp.asarray(values[name], jnp.float32) for name in ("gain", "damping"))
    armature = jnp.maximum(_beside_damping(jnp.asarray(values["armature"]), damping, step_s), 0.0)
    return {
        "gain": jnp.zeros((n, 10)).at[:, 0].set(gain),
        "bias": jnp.zeros((n, 10)).at[:, 1].set(-gain),
        # The torque limit is that at full duty, so it is proportional to the gain.
        "most": gain * sheet.full_rad * jnp.tile(jnp.array([[-1.0, 1.0]]), (n, 1)),
        "damping": jnp.full(n, damping),
        "armature": jnp.full(n, armature),
        "friction": jnp.stack([jnp.asarray(values[f"friction_{j}"], jnp.float32) for j in joints]),
    }


def identified_mjcf(
    mjcf: str, robot: ServoDriven, values: Mapping[str, Any], sheet: DataSheet, joints: Sequence[str]
) -> str:
    """Return a model's MJCF with given parameters, for use in other tools at its own time step.

    Args:
        mjcf: The composed model.
        robot: The robot in it.
        values: Parameters by name.
        sheet: The servo's data sheet.
        joints: Names of the joints.
    """
    spec: Any = mj.MjSpec.from_string(mjcf)
    gain = float(values["gain"])
    for name, element, actuator in zip(joints, robot.joints, robot.actuators, strict=True):
        joint, motor = spec.joint(element.full_identifier), spec.actuator(actuator.full_identifier)
        joint.damping = [float(values["damping"]), *joint.damping[1:]]
        armature = _beside_damping(float(values["armature"]), float(values["damping"]), spec.option.timestep)
        joint.armature = max(armature, 0.0)
        joint.frictionloss = float(values[f"friction_{name}"])
        motor.gainprm, motor.biasprm = [gain, *motor.gainprm[1:]], [0.0, -gain, *motor.biasprm[2:]]
        motor.forcerange = [-gain * sheet.full_rad, gain * sheet.full_rad]
    spec.compile()
    return spec.to_xml()


def _beside_damping(armature: Any, damping: Any, step_s: float) -> Any:
    """Return the inertia that is left to set; what the integrator adds is none of the rotor's.

    MuJoCo's implicit integration of damping acts like an additional inertia of half a step times the damping. At 2.5 ms
    that is 6 % of the rotors' inertia of pipelines/arm.
    """
    return armature - 0.5 * step_s * damping
