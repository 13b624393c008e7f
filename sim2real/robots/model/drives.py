"""Puts a drive on each recorded joint of an MJCF or URDF: actuators, encoders, payload, export to plain MuJoCo."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import mujoco
import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState, Value
from sim2real.graph.node import BaseNode
from sim2real.identification.model import PlainSimulation, converged
from sim2real.robots.messages import JointReading
from sim2real.robots.model.file import one_line, read_spec
from sim2real.robots.model.held import Holding, apply, plan
from sim2real.types import Array, Json, Key, MjModel, MjSpec, PyTree, Scalar
from sim2real.worlds.drive_terms import NO_LIMIT, DriveTerms
from sim2real.worlds.driven import PAYLOAD, DrivenWorld, DriveParams, payload_place
from sim2real.worlds.recorded import delay_of

mj: Any = mujoco

_LEAST_FRICTION, _LEAST_GRAVCOMP = 1e-9, 1e-9
_SOFT, _HOLDS = (0.02, 1.0, 0.9, 0.95, 0.001, 0.5, 2.0), 0.9999
"""MuJoCo's default solref and solimp of friction, and an impedance with which friction holds a joint."""
_OF_SLIDES = {"rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m", "kg m^2": "kg",
              "N m s^2/rad^2": "N s^2/m^2"}  # fmt: skip
"""Units of hinges -> units of slides."""


def joints_of(model: MjModel) -> tuple[str, ...]:
    """Return the names of a model's hinges and slides, in its order."""
    kinds = {int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE)}
    return tuple(model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) in kinds)


def slides_of(model: MjModel, joints: Sequence[str]) -> tuple[str, ...]:
    """Return which of the joints are slides: their units have m instead of rad, and N instead of N m."""
    return tuple(j for j in joints if int(model.joint(j).type[0]) == int(mj.mjtJoint.mjJNT_SLIDE))


def ranges_of(model: MjModel, joints: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the ranges of those of a model's joints that have one [rad or m]."""
    return {j: tuple(model.joint(j).range) for j in joints if model.jnt_limited[model.joint(j).id]}


def unit_for(unit: str, slide: bool) -> str:
    """Return the unit of a hinge's quantity, or the matching unit of a slide."""
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

    Each joint has three actuators, in the order: force of all joints, stiffness of all joints (force ``-ctrl *
    angle``), damping of all joints (``-ctrl * velocity``). Their sum stays within the torque limits of the file's
    actuators. Joints that were not recorded are held, except joints that move together with recorded ones; see
    ``held.plan``. If some move, the only keyframe of the model has the held positions.

    Args:
        step_s: Time step [s].
        fix_base: Whether a floating base is held at its position in the model.
        rubbing: Whether to give joints at least a little dry friction: MJX compiles no friction for a model without it.
        hold: Positions of joints that were not recorded: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
        carried: Whether to give bodies at least a little gravity compensation: MuJoCo skips it in a model without it.
        holder: Body that gets a payload of mass 0 at its centre of mass; "": the last joint's body; None: no payload.
    """
    # Hold the joints that were not recorded.
    spec = read_spec(path, contacts)
    model = spec.compile()
    holding = held_in(path, model, joints, fix_base, hold)
    limits = {j: limit_of(model, j) for j in joints}
    apply(spec, model, holding)
    if holder is not None:
        add_payload(spec, model, joints, holder)

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
    """Remove bias and limits, which a new actuator takes from the file's default servos."""
    part.biastype, part.dyntype, part.biasprm[:] = mj.mjtBias.mjBIAS_NONE, mj.mjtDyn.mjDYN_NONE, 0.0
    part.gear[:] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    part.ctrllimited = part.forcelimited = False


def stick(spec: MjSpec, joints: Sequence[str], step_s: float) -> None:
    """Let dry friction hold joints, unless the file sets an impedance: at MuJoCo's default, joints creep.

    Args:
        step_s: Time step of the simulation [s].
    """
    for joint in (spec.joint(name) for name in joints):
        if np.allclose(joint.solref_friction, _SOFT[:2]) and np.allclose(joint.solimp_friction, _SOFT[2:]):
            joint.solref_friction, joint.solimp_friction[:2] = [2 * step_s, 1.0], _HOLDS


def copy_back(spec: MjSpec, model: MjModel) -> None:
    """Copy a compiled model's numbers into its ``MjSpec``, also the gravity compensation, which MuJoCo omits."""
    spec.copy_back(model)
    for body in spec.bodies[1:]:
        body.gravcomp = float(model.body_gravcomp[body.id])


def driven(path: Path, *how: PyTree) -> MjModel:
    """Return the compiled model of ``driven_spec``."""
    spec = driven_spec(path, *how)
    try:
        return spec.compile()
    except ValueError as error:
        raise UsageError(
            f"{path} does not compile with joints held: {one_line(error)}",
            hint="remove the elements that need the held joints from the model",
        ) from None


def held_in(path: Path, model: MjModel, joints: Sequence[str], fix_base: bool, hold: Sequence[str]) -> Holding:
    """Return which joints of a file's compiled model ``driven`` holds.

    Args:
        hold: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
    """
    available = joints_of(model)
    if unknown := [j for j in joints if j not in available]:
        raise UsageError(f"{path} has no joint {unknown[0]!r}. Available: {', '.join(available)}")
    return plan(model, joints, hold, fix_base, path)


def set_drive(
    spec: MjSpec,
    joint: str,
    control: Literal["position", "velocity", "torque"],
    stiffness: float,
    damping: float,
    gain: float,
    most: float | None,
) -> None:
    """Give a joint of a model one actuator: the file's if it has any, otherwise a new one.

    Args:
        control: Quantity of its control.
        stiffness: Gain of a position control [N m/rad].
        damping: Damping [N m s/rad]; also the gain of a velocity control.
        gain: Torque for each unit of a torque control [N m].
        most: Largest torque [N m]; None: no limit.
    """
    actuators = [a for a in spec.actuators if a.trntype == mj.mjtTrn.mjTRN_JOINT and a.target == joint]
    for element in actuators[1:]:
        spec.delete(element)
    part: Any = (
        actuators[0] if actuators else spec.add_actuator(name=joint, target=joint, trntype=mj.mjtTrn.mjTRN_JOINT)
    )
    _clear(part)
    part.gaintype, part.biastype = mj.mjtGain.mjGAIN_FIXED, mj.mjtBias.mjBIAS_AFFINE
    part.gainprm[:3] = [{"position": stiffness, "velocity": damping, "torque": gain}[control], 0.0, 0.0]
    part.biasprm[:3] = [0.0, -stiffness if control == "position" else 0.0, -damping]
    if most is not None:  # at the joint, as in identification: MuJoCo then integrates damping implicitly
        spec.joint(joint).actfrclimited, spec.joint(joint).actfrcrange = True, [-most, most]


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
    """Return the force at the joint for a command of 1 to the file's motor; None: the joint has no motor."""
    for i in _actuators(model, model.joint(joint).id):
        if model.actuator_biastype[i] == int(mj.mjtBias.mjBIAS_NONE):
            return abs(float(model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0]))
    return None


def _actuators(model: MjModel, joint: int) -> list[int]:
    of_joint = model.actuator_trntype == int(mj.mjtTrn.mjTRN_JOINT)
    return [int(i) for i in np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == joint))]


_NO_MASS = 1e-9


def add_payload(spec: MjSpec, model: MjModel, joints: Sequence[str], holder: str) -> None:
    """Add a payload of mass 0 to a model; mass and place are set for each log.

    Args:
        holder: Body that holds it, at its centre of mass; "": the last joint's body.
    """
    names = [model.body(i).name for i in range(1, model.nbody)]
    if holder and holder not in names:
        raise UsageError(f"no body {holder!r} for the payload. Available: {', '.join(filter(None, names))}")
    body: Any = spec.body(holder) if holder else spec.joint(joints[-1]).parent
    middle = model.body_ipos[model.body(holder).id if holder else model.jnt_bodyid[model.joint(joints[-1]).id]]
    if not np.any(middle):
        raise UsageError(
            f"the centre of mass of body {body.name!r} is at its origin, so a payload has no direction from there",
            hint="give the body an inertial, or name another one with --payload-body",
        )
    payload = body.add_body(name=PAYLOAD, pos=middle)
    payload.explicitinertial, payload.mass, payload.inertia = True, _NO_MASS, [_NO_MASS] * 3
    payload.ipos, payload.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]  # a new body would have the class of its holder


def with_payload_of(model: MjModel, sent: Mapping[str, np.ndarray]) -> MjModel:
    """Return a model with the payload of a log, if it has one.

    Args:
        sent: The log's commands by field.
    """
    if all(model.body(i).name != PAYLOAD for i in range(model.nbody)):
        return model
    model = copy.copy(model)
    model.body(PAYLOAD).mass[:] += sent["payload"][0, 0]
    if "payload_reach" in sent:
        model.body(PAYLOAD).pos[:] = payload_place(model, sent["payload_reach"][0, 0])
    return model


class Encoders(BaseNode):
    """Reads the joints of a ``DrivenWorld``.

    Args:
        rate: Samples per second [Hz].
    """

    def __init__(self, name: str, rate: float, world: DrivenWorld, velocity: bool) -> None:
        super().__init__(name, rate)
        self._world, self._velocity = world, velocity

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> EncoderParams:
        world = self._world.init_params(rng, graph_state)
        return EncoderParams(jnp.zeros(len(self._world.qpos_at)), world.terms)

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> JointReading:
        del rng, graph_state
        still = jnp.zeros(len(self._world.qpos_at))
        return JointReading(still, still if self._velocity else None)

    def init_delays(self, rng: Key | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        return delay_of(self.name, self._world.name, graph_state)

    def step(self, step_state: StepState) -> tuple[StepState, JointReading]:
        message, params = step_state.inputs[self._world.name][-1].data, step_state.params
        angle, speed = message.qpos[self._world.qpos_at], message.qvel[self._world.qvel_at]
        if params.terms is not None:
            angle, speed = params.terms.read(angle), params.terms.rate(angle, speed)
        return step_state, JointReading(angle + params.zero, speed if self._velocity else None)


@pytree.dataclass
class EncoderParams(Base):
    """Parameters of the encoders.

    Attributes:
        zero: Readings at the model's zero, ``(joints,)`` [rad].
        terms: Terms of the drives, among them the eccentricity of encoders; None: no eccentricity.
        delay: Delay of the readings [s]; None: the delay of the connection.
    """

    zero: Array
    terms: DriveTerms | None = None
    delay: Scalar | None = None


def driven_simulation(
    params_of: Callable[[np.ndarray], DriveParams], world: DrivenWorld, how: tuple[Json, ...]
) -> PlainSimulation:
    """Return the driven model with identified values, and the numbers of its drives.

    Args:
        params_of: Measured positions and velocities ``(2 * joints,)`` -> the world's parameters.
        how: Arguments of ``driven_spec``, which begin with path, joints and time step.
    """
    n = len(world.joints)
    params = params_of(np.zeros(2 * n))
    # Set the fields of the model that the values change.
    spec = driven_spec(*how)
    model = spec.compile()
    for name, value in world.fields(params, None).items():
        holder, _, field = name.rpartition(".")
        getattr(model.opt if holder else model, field)[...] = np.asarray(value)
    copy_back(spec, model)
    for joint, number in zip(how[1], world.joints, strict=True):  # MuJoCo's copy_back also omits the limits
        spec.joint(joint).actfrcrange = model.jnt_actfrcrange[number]
    mjcf = converged(spec)
    made = mj.MjModel.from_xml_string(mjcf)
    for name in world.fields(params, None):
        holder, _, field = name.rpartition(".")
        pair = (getattr(m.opt if holder else m, field) for m in (model, made))
        if not np.allclose(*pair, rtol=1e-4, atol=1e-9):
            raise UsageError(f"MJCF does not keep the identified {name} of this model", hint="export to json")
    # Collect the numbers of the drives.
    numbers = {
        f: np.asarray(getattr(params, f)) + np.zeros(n) for f in ("kp", "kd", "gain", "released", "zero", "voltage")
    }
    numbers |= {
        name: np.array(unit) for name, unit in zip(("kp_unit", "kd_unit", "volts_unit"), world.units, strict=True)
    }
    numbers |= {"joints_at": world.joints, "qpos_at": world.qpos_at, "qvel_at": world.qvel_at}
    if params.terms is not None:
        numbers |= {f.name: np.asarray(getattr(params.terms, f.name)) + np.zeros(n) for f in fields(DriveTerms)}

    def begin(start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        started = params_of(start)
        return np.asarray(started.qpos), np.asarray(started.qvel)

    return PlainSimulation(mjcf, how[1], how[2], begin, "drive", numbers, lead_s=world.lead_s)
