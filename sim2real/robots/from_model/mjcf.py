"""A robot's MJCF or URDF, made ready for identification: its joints, and a drive on each that was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from sim2real.errors import UsageError
from sim2real.robots.from_model import model_file, payload
from sim2real.robots.from_model.holding import Holding, apply, plan
from sim2real.types import MjModel, MjSpec, PyTree
from sim2real.worlds.drive_terms import NO_LIMIT

mj: Any = mujoco

_LEAST_FRICTION, _LEAST_GRAVCOMP = 1e-9, 1e-9
_SOFT, _HOLDS = (0.02, 1.0, 0.9, 0.95, 0.001, 0.5, 2.0), 0.9999
"""MuJoCo's default solref and solimp of friction, and the impedance of friction that holds a joint."""
_OF_SLIDES = {"rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m", "kg m^2": "kg",
              "N m s^2/rad^2": "N s^2/m^2"}  # fmt: skip
"""Units of hinges -> units of slides."""


def read_spec(path: Path, contacts: bool = False) -> MjSpec:
    """Return the ``mujoco.MjSpec`` of an MJCF or URDF file; see ``model_file.read``."""
    return model_file.read(path, contacts)[0]


def read_model(path: Path) -> MjModel:
    """Return the compiled model of an MJCF or URDF file; see ``read_spec``."""
    return read_spec(path).compile()


def joints_of(model: MjModel) -> tuple[str, ...]:
    """Return the names of a model's hinges and slides, in its order."""
    kinds = {int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE)}
    return tuple(model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) in kinds)


def slides_of(model: MjModel, joints: Sequence[str]) -> tuple[str, ...]:
    """Return those of a model's joints that are slides: their units have m for rad, and N for N m."""
    return tuple(j for j in joints if int(model.joint(j).type[0]) == int(mj.mjtJoint.mjJNT_SLIDE))


def unit_for(unit: str, slide: bool) -> str:
    """Return the unit of a hinge's quantity, or what takes its place at a slide."""
    return _OF_SLIDES.get(unit, unit) if slide else unit


def driven_spec(
    path: Path,
    joints: Sequence[str],
    step_s: float,
    fix_base: bool,
    contacts: bool,
    rubbing: bool = True,
    hold: Sequence[str] = (),
    carried: bool = False,
    holder: str | None = None,
) -> MjSpec:
    """Return the ``MjSpec`` with a drive on each recorded joint: actuators of force, of stiffness and of damping.

    The actuators of force come first, in the order of the joints, then those of stiffness, whose force is
    ``-ctrl * angle``, then those of damping, ``-ctrl * velocity``. Their sum stays within the torque limits of the
    file's own actuators. Joints that were not recorded are held, except joints that move together with recorded ones;
    see ``holding.plan``. If some move, the keyframe of the held joints is the model's only keyframe.

    Args:
        step_s: Time step [s].
        fix_base: Whether a floating base is held at its position in the model.
        rubbing: Whether joints have at least a little dry friction: MJX compiles no friction for a model without any.
        hold: Positions of joints that were not recorded: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
        carried: Whether bodies have at least a little gravity compensation: MuJoCo computes none without any.
        holder: Body that gets a payload without mass, at its centre of mass; "": that of the last joint.
    """
    # Hold the joints that were not recorded.
    spec = read_spec(path, contacts)
    model = spec.compile()
    holding = held_in(path, model, joints, fix_base, hold)
    limits = {j: limit_of(model, j) for j in joints}
    apply(spec, model, holding)
    if holder is not None:
        payload.hold(spec, model, joints, holder)

    # Add the actuators, and give each joint its torque limit.
    for what, gain in (("force", (1.0, 0.0, 0.0)), ("kp", (0.0, -1.0, 0.0)), ("kd", (0.0, 0.0, -1.0))):
        for joint in joints:
            part: Any = spec.add_actuator(name=f"{joint}_{what}", target=joint, trntype=mj.mjtTrn.mjTRN_JOINT)
            part.gaintype, part.gainprm[:3] = mj.mjtGain.mjGAIN_AFFINE, gain
            _clear(part)
    for joint in joints:
        most = limits[joint] or NO_LIMIT
        spec.joint(joint).actfrclimited, spec.joint(joint).actfrcrange = True, [-most, most]
        if rubbing:
            spec.joint(joint).frictionloss = max(float(np.ravel(spec.joint(joint).frictionloss)[0]), _LEAST_FRICTION)

    stick(spec, joints, step_s)

    # Set the options that identification needs, and compile.
    if carried and not np.any(model.body_gravcomp > 0.0):
        for body in spec.bodies[1:]:
            body.gravcomp = _LEAST_GRAVCOMP
    option = spec.option
    option.timestep, option.integrator = step_s, mj.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.noslip_iterations = mj.mjtCone.mjCONE_PYRAMIDAL, 0
    if not contacts:
        option.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONTACT)
    return spec


def _clear(part: Any) -> None:
    """Leave an actuator its gain alone: a new one has bias and limits of the file's default servos."""
    part.biastype, part.dyntype, part.biasprm[:] = mj.mjtBias.mjBIAS_NONE, mj.mjtDyn.mjDYN_NONE, 0.0
    part.gear[:] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    part.ctrllimited = part.forcelimited = False


def stick(spec: MjSpec, joints: Sequence[str], step_s: float) -> None:
    """Let dry friction hold joints, unless the file has an impedance of its own: at MuJoCo's default they creep.

    Args:
        step_s: Time step of the simulation [s].
    """
    for joint in (spec.joint(name) for name in joints):
        if np.allclose(joint.solref_friction, _SOFT[:2]) and np.allclose(joint.solimp_friction, _SOFT[2:]):
            joint.solref_friction, joint.solimp_friction[:2] = [2 * step_s, 1.0], _HOLDS


def copy_back(spec: MjSpec, model: MjModel) -> None:
    """Copy a compiled model's numbers into its ``MjSpec``, with the gravity compensation, which MuJoCo's own omits."""
    spec.copy_back(model)
    for body in spec.bodies[1:]:
        body.gravcomp = float(model.body_gravcomp[body.id])


def driven(path: Path, *how: PyTree) -> MjModel:
    """Return the compiled model of ``driven_spec``, and raise what that raises."""
    spec = driven_spec(path, *how)
    try:
        return spec.compile()
    except ValueError as error:
        raise UsageError(
            f"{path} does not compile with joints held: {model_file.one_line(error)}",
            hint="remove the elements that need them from the model",
        ) from None


def held_in(path: Path, model: MjModel, joints: Sequence[str], fix_base: bool, hold: Sequence[str]) -> Holding:
    """Return which joints of a file's compiled model are held, as ``driven`` holds them.

    Args:
        hold: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
    """
    available = joints_of(model)
    if unknown := [j for j in joints if j not in available]:
        raise UsageError(f"{path} has no joint {unknown[0]!r}. Available: {', '.join(available)}")
    return plan(model, joints, hold, fix_base, path)


@dataclass(frozen=True)
class JointDrive:
    """One actuator of a joint.

    Attributes:
        control: Quantity of its control.
        stiffness: Gain of a position control [N m/rad].
        damping: Damping [N m s/rad]; also the gain of a velocity control.
        gain: Torque for each unit of a torque control [N m].
        most: Largest torque [N m]; None: no limit.
    """

    control: Literal["position", "velocity", "torque"]
    stiffness: float
    damping: float
    gain: float
    most: float | None


def set_drives(spec: MjSpec, drives: Mapping[str, JointDrive]) -> None:
    """Give joints of a model one actuator each: the file's actuator if it has exactly one, otherwise a new one.

    Args:
        spec: ``mujoco.MjSpec`` of the model; it is changed.
    """
    # Leave one actuator on each joint, and set its gains.
    fixed, affine = mj.mjtGain.mjGAIN_FIXED, mj.mjtBias.mjBIAS_AFFINE
    for joint, drive in drives.items():
        actuators = [a for a in spec.actuators if a.trntype == mj.mjtTrn.mjTRN_JOINT and a.target == joint]
        for element in actuators[1:]:
            spec.delete(element)
        part: Any = (
            actuators[0] if actuators else spec.add_actuator(name=joint, target=joint, trntype=mj.mjtTrn.mjTRN_JOINT)
        )
        gain = {"position": drive.stiffness, "velocity": drive.damping, "torque": drive.gain}[drive.control]
        stiffness = drive.stiffness if drive.control == "position" else 0.0
        part.gaintype, part.biastype, part.dyntype = fixed, affine, mj.mjtDyn.mjDYN_NONE
        part.gear[:] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        part.gainprm[:3], part.biasprm[:3] = [gain, 0.0, 0.0], [0.0, -stiffness, -drive.damping]
        part.ctrllimited = False  # the file's range may be a torque
        part.forcelimited = False
        if drive.most is not None:  # at the joint, as in identification: MuJoCo then integrates damping implicitly
            spec.joint(joint).actfrclimited, spec.joint(joint).actfrcrange = True, [-drive.most, drive.most]


def limit_of(model: MjModel, joint: str) -> float | None:
    """Return the largest torque that the file's own actuator or joint allows [N m or N]; None: no limit."""
    number = model.joint(joint).id
    ranges = [
        model.actuator_forcerange[i] * model.actuator_gear[i, 0]
        for i in _actuators(model, number)
        if model.actuator_forcelimited[i]
    ]
    # The control of a motor is its torque, so a range of the control is a limit, too.
    ranges += [
        model.actuator_ctrlrange[i] * model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0]
        for i in _actuators(model, number)
        if model.actuator_ctrllimited[i] and model.actuator_biastype[i] == int(mj.mjtBias.mjBIAS_NONE)
    ]
    ranges += [model.jnt_actfrcrange[number]] if model.jnt_actfrclimited[number] else []
    limits = [float(np.abs(r).max()) for r in ranges if np.abs(r).max() > 0]
    return min(limits, default=None)


def gains_of(model: MjModel, joint: str) -> tuple[float, float] | None:
    """Return stiffness and damping at the joint of the file's position or velocity servo; None: the joint has none.

    A gear multiplies the force, and the angle and the speed that the servo sees.
    """
    for i in _actuators(model, model.joint(joint).id):
        if model.actuator_biastype[i] == int(mj.mjtBias.mjBIAS_AFFINE):
            square = float(model.actuator_gear[i, 0]) ** 2
            return float(-square * model.actuator_biasprm[i, 1]), float(-square * model.actuator_biasprm[i, 2])
    return None


def force_of(model: MjModel, joint: str) -> float | None:
    """Return the force at the joint for a command of 1 to the file's motor, with its gear; None: the joint has none."""
    for i in _actuators(model, model.joint(joint).id):
        if model.actuator_biastype[i] == int(mj.mjtBias.mjBIAS_NONE):
            return abs(float(model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0]))
    return None


def _actuators(model: MjModel, joint: int) -> list[int]:
    of_joint = model.actuator_trntype == int(mj.mjtTrn.mjTRN_JOINT)
    return [int(i) for i in np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == joint))]
