"""The parameters of a robot whose servos are all of one model: shared ones, and those of each joint.

They are at a servo's shaft, as in its data sheet. At a joint with a gear, torque and friction are multiplied by the
gear, and gain, damping and inertia by its square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sim2real.arrays import beside_damping
from sim2real.identify.export.plain import converged
from sim2real.identify.parameters import Parameter
from sim2real.later import jax, jnp
from sim2real.robots.servo.datasheet import DataSheet
from sim2real.robots.servo.parts import ServoDriven
from sim2real.robots.servo.servos import gear_of, name_of
from sim2real.types import MjSpec, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.hardware.joint import Joint

mj: Any = mujoco
_NAMES = ("gain", "damping", "armature", "friction")
MISSES = "goal_offset"
"""Constant difference between a servo's position and its goal [rad]: of the zeros, or of worn gears."""
_NEVER_RAD_S = 1e6
"""Speed at which friction has worn off, where it does not."""
_MOST_RAD = 0.05
STRIBECK = "stribeck_rad_s"
"""Value of the world's parameters ``(joints,)`` [rad/s]."""


def parameters(sheet: DataSheet, joints: Sequence[Joint | str], own: Sequence[str] = ("friction",)) -> list[Parameter]:
    """Return gain, damping, rotor inertia and friction, bounded to factors of 3 to 10 of the data sheet.

    If friction decreases with speed, the width of this decrease, ``stribeck``, is a parameter.

    Args:
        own: Quantities with a value for each joint, named as ``friction_JOINT``; joints share the others.
    """
    rows = []
    for name, (unit, factor, about) in {
        "gain": ("N m/rad", 3, "torque per error, at the P gain in use"),
        "damping": ("N m s/rad", 4, "back-EMF, viscous friction"),
        "armature": ("kg m^2", 4, "rotor behind the gears"),
        "friction": ("N m", 8, "dry friction"),
    }.items():
        value = getattr(sheet, name)
        names = [f"{name}_{name_of(j)}" for j in joints] if name in own else [name]
        gone = name != "gain"
        rows += [Parameter(n, unit, value, value / factor, value * factor, about=about, vanishes=gone) for n in names]
    if (width := sheet.stribeck_rad_s) is not None:
        about = "speed at which 1/e of the dry friction is left"
        names = [f"stribeck_{name_of(j)}" for j in joints] if "stribeck" in own else ["stribeck"]
        rows += [Parameter(n, "rad/s", width, width / 10, width * 10, about=about) for n in names]
    return rows


def offsets(joints: Sequence[Joint | str]) -> list[Parameter]:
    """Return the offset of each servo from its goals, for ``dynamics``."""
    about = "rest position without load, from its goal"
    names = [f"{MISSES}_{name_of(joint)}" for joint in joints]
    return [Parameter(name, "rad", 0.0, -_MOST_RAD, _MOST_RAD, "linear", about=about) for name in names]


def causes(joints: Sequence[Joint | str]) -> dict[str, dict[str, float]]:
    """Return the causes that change parameters of all joints: the temperature of grease and gears changes friction."""
    return {"friction": {f"friction_{name_of(joint)}": 1.0 for joint in joints}}


def of_joints(
    values: Mapping[str, Scalar], name: str, joints: Sequence[Joint | str], otherwise: float | None = None
) -> list[Scalar]:
    """Return the value of every joint's servo: its own, otherwise the shared one.

    Args:
        name: Such as ``gain``; a joint's own is ``gain_JOINT``.
        otherwise: The value without both; None: a missing value is an error.
    """
    shared, labels = values.get(name, otherwise), [f"{name}_{name_of(j)}" for j in joints]
    entries = [values.get(label, shared) for label in labels]
    if lacking := [label for label, value in zip(labels, entries, strict=True) if value is None]:
        raise KeyError(lacking[0])
    return [entry for entry in entries if entry is not None]


def fields(robot: ServoDriven) -> dict[str, tuple[PyTree, str]]:
    """Return the parts of a composed model that the parameters set: name -> (elements, attribute)."""
    return {
        "gain": (robot.actuators, "gainprm"),
        "bias": (robot.actuators, "biasprm"),
        "most": (robot.actuators, "forcerange"),
        "damping": (robot.joints, "damping"),
        "armature": (robot.joints, "armature"),
        "friction": (robot.joints, "frictionloss"),
    }


def place(
    values: Mapping[str, Scalar], sheet: DataSheet, joints: Sequence[Joint | str], step_s: float
) -> dict[str, PyTree]:
    """Return the arrays of ``fields`` for parameters by name.

    Args:
        step_s: The physics' time step [s].
    """
    gear = np.array([gear_of(joint) for joint in joints], np.float32)
    gain, damping, inertia, friction, full, off = (
        _stacked(of_joints(values, name, joints, otherwise))
        for name, otherwise in (*((name, None) for name in _NAMES), ("saturation", sheet.full_rad), (MISSES, 0.0))
    )
    worn = {STRIBECK: _stacked(of_joints(values, "stribeck", joints, _NEVER_RAD_S)) / gear} if sheet.worn else {}
    stiffness, zero = gain * gear**2, 0.0 * gain
    armature = beside_damping(inertia, damping, step_s)
    return {
        "gain": jnp.stack([stiffness, *[zero] * 9], axis=-1),
        "bias": jnp.stack([gain * off * gear, -stiffness, *[zero] * 8], axis=-1),
        # The torque limit is that at full duty, so it is proportional to the gain.
        "most": (gain * full * gear)[..., None] * jnp.array([-1.0, 1.0]),
        "damping": damping * gear**2,
        "armature": armature * gear**2,
        "friction": friction * gear,
        **worn,
    }


def _stacked(each: Sequence[Scalar]) -> jax.Array:
    """Return numbers of the joints ``(..., joints)``."""
    return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(v, jnp.float32) for v in each)), axis=-1)


def identified_mjcf(
    mjcf: str, robot: ServoDriven, values: Mapping[str, Scalar], sheet: DataSheet, joints: Sequence[Joint | str]
) -> str:
    """Return a model's MJCF with given parameters, for use in other tools at its own time step."""
    spec: MjSpec = mj.MjSpec.from_string(mjcf)
    columns = [of_joints(values, name, joints) for name in _NAMES]
    columns += [of_joints(values, "saturation", joints, sheet.full_rad), of_joints(values, MISSES, joints, 0.0)]
    rows = zip(joints, robot.joints, robot.actuators, zip(*columns, strict=True), strict=True)
    for mounted, element, actuator, numbers in rows:
        gear = gear_of(mounted)
        gain, damping, armature, friction, full, off = (float(n) for n in numbers)
        joint, motor = spec.joint(element.full_identifier), spec.actuator(actuator.full_identifier)
        joint.damping = [damping * gear**2, *joint.damping[1:]]
        joint.armature = float(beside_damping(armature, damping, spec.option.timestep)) * gear**2
        joint.frictionloss = friction * gear
        stiffness, most = gain * gear**2, gain * full * gear
        motor.gainprm = [stiffness, *motor.gainprm[1:]]
        motor.biasprm = [gain * off * gear, -stiffness, *motor.biasprm[2:]]
        motor.forcerange = [-most, most]
    return converged(spec)
