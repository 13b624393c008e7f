"""The parameters of a robot whose servos are all of one model: shared ones, and those of each joint.

They are a servo's, at its shaft, as in its data sheet. A joint with a gear feels torque and friction times the gear,
and gain, damping and inertia times its square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from sim2real.composer.models.mjcf.translate import mj
from sim2real.identify.parameters import Parameter
from sim2real.robots.servo.datasheet import DataSheet
from sim2real.robots.servo.parts import ServoDriven
from sim2real.robots.servo.servos import gear_of, name_of
from sim2real.robots.servo.simulated_world import STRIBECK

if TYPE_CHECKING:
    from sim2real.hardware.joint import Joint

_NAMES = ("gain", "damping", "armature", "friction")
MISSES = "goal_offset"
"""By how much a servo misses its goals [rad]: their zero is not the encoder's, or gears hang."""
_MOST_RAD = 0.05


def parameters(sheet: DataSheet, joints: Sequence[Joint | str], own: Sequence[str] = ("friction",)) -> list[Parameter]:
    """Return gain, damping, rotor inertia and friction, bounded to factors of 3 to 10 of the data sheet.

    Where friction wears off with speed, how fast is a parameter, too, which all joints share.

    Args:
        joints: The joints, or their names.
        own: Which of these each joint has for itself, named as ``friction_JOINT``; joints share the others.
    """
    found = []
    for name, (unit, factor, about) in {
        "gain": ("N m/rad", 3, "torque per error, at the P gain in use"),
        "damping": ("N m s/rad", 4, "back-EMF, viscous friction"),
        "armature": ("kg m^2", 4, "rotor behind the gears"),
        "friction": ("N m", 8, "dry friction"),
    }.items():
        value = getattr(sheet, name)
        names = [f"{name}_{name_of(j)}" for j in joints] if name in own else [name]
        gone = name != "gain"
        found += [Parameter(n, unit, value, value / factor, value * factor, about=about, vanishes=gone) for n in names]
    if (width := sheet.stribeck_rad_s) is not None:
        about = "speed at which 1/e of the dry friction is left"
        found.append(Parameter("stribeck", "rad/s", width, width / 10, width * 10, about=about))
    return found


def offsets(joints: Sequence[Joint | str]) -> list[Parameter]:
    """Return by how much the servo of each joint misses its goals, for ``ServoRobot.dynamics``.

    Args:
        joints: The joints, or their names.
    """
    about = "where it comes to rest without load, from its goal"
    names = [f"{MISSES}_{name_of(joint)}" for joint in joints]
    return [Parameter(name, "rad", 0.0, -_MOST_RAD, _MOST_RAD, "linear", about=about) for name in names]


def causes(joints: Sequence[Joint | str]) -> dict[str, dict[str, float]]:
    """Return what moves parameters of all joints at once: friction, with the temperature of grease and gears."""
    return {"friction": {f"friction_{name_of(joint)}": 1.0 for joint in joints}}


def of_joints(
    values: Mapping[str, Any], name: str, joints: Sequence[Joint | str], otherwise: float | None = None
) -> list[Any]:
    """Return the value of every joint's servo: its own, else the shared one.

    Args:
        name: Such as ``gain``; a joint's own is ``gain_JOINT``.
        joints: The joints, or their names.
        otherwise: The value where there is neither; None: one of them must be there.
    """
    shared, labels = values.get(name, otherwise), [f"{name}_{name_of(j)}" for j in joints]
    found = [values.get(label, shared) for label in labels]
    if lacking := [label for label, value in zip(labels, found, strict=True) if value is None]:
        raise KeyError(lacking[0])
    return found


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
        joints: The joints, or their names.
        step_s: The physics' time step [s].
    """
    n, gear = len(joints), np.array([gear_of(joint) for joint in joints], np.float32)
    gain, damping, inertia, friction, full, off = (
        jnp.stack([jnp.asarray(v, jnp.float32) for v in of_joints(values, name, joints, otherwise)])
        for name, otherwise in (*((name, None) for name in _NAMES), ("saturation", sheet.full_rad), (MISSES, 0.0))
    )
    worn = {STRIBECK: jnp.stack(of_joints(values, "stribeck", joints, jnp.inf)) / gear} if sheet.worn else {}
    armature = jnp.maximum(_beside_damping(inertia, damping, step_s), 0.0)
    return {
        "gain": jnp.zeros((n, 10)).at[:, 0].set(gain * gear**2),
        "bias": jnp.zeros((n, 10)).at[:, 0].set(gain * off * gear).at[:, 1].set(-gain * gear**2),
        # The torque limit is that at full duty, so it is proportional to the gain.
        "most": (gain * full * gear)[:, None] * jnp.array([-1.0, 1.0]),
        "damping": damping * gear**2,
        "armature": armature * gear**2,
        "friction": friction * gear,
        **worn,
    }


def identified_mjcf(
    mjcf: str, robot: ServoDriven, values: Mapping[str, Any], sheet: DataSheet, joints: Sequence[Joint | str]
) -> str:
    """Return a model's MJCF with given parameters, for use in other tools at its own time step.

    Args:
        joints: The joints, or their names.
    """
    spec: Any = mj.MjSpec.from_string(mjcf)
    found = [of_joints(values, name, joints) for name in _NAMES]
    found += [of_joints(values, "saturation", joints, sheet.full_rad), of_joints(values, MISSES, joints, 0.0)]
    rows = zip(joints, robot.joints, robot.actuators, zip(*found, strict=True), strict=True)
    for mounted, element, actuator, numbers in rows:
        gear = gear_of(mounted)
        gain, damping, armature, friction, full, off = (float(n) for n in numbers)
        joint, motor = spec.joint(element.full_identifier), spec.actuator(actuator.full_identifier)
        joint.damping = [damping * gear**2, *joint.damping[1:]]
        joint.armature = max(_beside_damping(armature, damping, spec.option.timestep), 0.0) * gear**2
        joint.frictionloss = friction * gear
        stiffness, most = gain * gear**2, gain * full * gear
        motor.gainprm = [stiffness, *motor.gainprm[1:]]
        motor.biasprm = [gain * off * gear, -stiffness, *motor.biasprm[2:]]
        motor.forcerange = [-most, most]
    spec.compile()
    return spec.to_xml()


def _beside_damping(armature: Any, damping: Any, step_s: float) -> Any:
    """Return the inertia that is left to set; what the integrator adds is none of the rotor's.

    MuJoCo's implicit integration of damping acts like an additional inertia of half a step times the damping. At 2.5 ms
    that is 6 % of the rotors' inertia of pipelines/arm.
    """
    return armature - 0.5 * step_s * damping
