"""An MJCF with a position servo on each joint, as the model of a robot: its world, its parameters, and its export.

The parameters are at a servo's shaft, as in its data sheet. At a joint with a gear, torque and friction are multiplied
by the gear, and gain, damping and inertia by its square.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np

from sim2real.arrays import beside_damping
from sim2real.errors import UsageError
from sim2real.hardware.device import RESPONSE_S, Following
from sim2real.identification.export.targets import Late
from sim2real.identification.model import PlainSimulation, converged
from sim2real.identification.parameters import Parameter
from sim2real.later import jnp
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import PAYLOAD, Embedded, Exported, RobotModel
from sim2real.robots.servo.servos import DataSheet, Servos
from sim2real.types import MjModel, MjSpec, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.emulation.bus import BusEmulation
    from sim2real.robots.servo.world import ServoParams, ServoWorld

mj: Any = mujoco

OFFSET = "goal_offset"
"""Largest constant difference between a servo's position and its goal, from zeros or worn gears [rad]."""
_NAMES = ("gain", "damping", "armature", "friction")
_NEVER = 1e9
"""Speed that stands for infinity [rad/s]."""
LIMIT_RAD: Final = 0.15
"""Largest distance of a sound joint from where goals, weight and friction put it [rad]; 0.11 rad was measured with all
payloads.
"""
_SHARE, _LEAST_RAD_S = 0.5, 0.1
"""Number of poses in which the weight is computed; lowest speed of a moving joint, as a share of the free speed and in
rad/s.
"""
_MOST_OFFSET_RAD = 0.05
_SOON, _STOPS = [1e-4, 1.0], [0.995, 0.995, 0.001, 0.5, 2.0]
"""MuJoCo's solref and solimp of dry friction, which stops a joint within two time steps. At the default impedance
joints creep; at 0.999 the solver, in single precision, does not find the force that holds a joint.
"""


@dataclass(frozen=True)
class Hand:
    """The hand of a robot, which may hold a payload.

    The payload's inertia about its centre is neglected: the inertia of the rotors, behind gears, is far larger.

    Attributes:
        joint: The joint that moves the link with the hand.
        at_m: Position of a payload in the frame of this link [m].
        most_kg: Largest payload [kg].
        least_kg: Lower bound of the payload [kg], negative if mass was removed since the identification; the link
            weighs more.
    """

    joint: str
    at_m: tuple[float, float, float]
    most_kg: float
    least_kg: float = 0.0

    def parameter(self) -> Parameter:
        """Return the payload, an optional term: a gain and a mass are hard to separate."""
        about = "mass in the hand, beyond that of the model"
        more: dict[str, Any] = {"about": about, "free": False, "term": PAYLOAD, "off": 0.0}
        return Parameter(PAYLOAD, "kg", 0.0, self.least_kg, self.most_kg, "linear", **more)


class ServoModel(RobotModel):
    """An MJCF on MJX with a position servo on each joint.

    Args:
        mjcf: The model, whose hinges have the names of the servos' joints. Drives, friction and rotors are added.
        step_s: Time step of the physics [s].
        dynamics: Returns the parameters; default: those of the servos, and the payload.
    """

    def __init__(
        self,
        servos: Servos,
        mjcf: Path,
        hand: Hand | None = None,
        *,
        step_s: float = 0.0025,
        tick_s: float = 0.01,
        dynamics: Callable[[], list[Parameter]] | None = None,
    ) -> None:
        self.servos, self.mjcf, self.hand = servos, mjcf, hand
        self.step_s, self.tick_s, self.lead_s, self._dynamics = step_s, tick_s, 0.5 * step_s, dynamics

    def dynamics(self) -> list[Parameter]:
        if self._dynamics is not None:
            return self._dynamics()
        of_servos = servo_parameters(self.servos.sheet, self.servos.names)
        return [*of_servos, self.hand.parameter()] if self.hand else of_servos

    def make_world(self, resumed: bool = False) -> ServoWorld:
        from sim2real.robots.servo.world import ServoWorld  # imported late: record needs no physics

        s = self.servos
        profiles = [s.sheet.profile_rad_s / gear for gear in s.gears]
        return ServoWorld(self.model, s.names, self.tick_s, profiles, resumed, s.sheet.stribeck_rad_s is not None)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> ServoParams:
        from sim2real.robots.servo.world import ServoParams

        model, (qpos_at, qvel_at) = self.model, self._places
        position, velocity = (jnp.asarray(x, jnp.float32) for x in (start.position, start.velocity))
        qpos = jnp.asarray(model.qpos0, jnp.float32).at[qpos_at].set(position)
        qvel = jnp.zeros(model.nv, jnp.float32).at[qvel_at].set(velocity)
        return ServoParams(self.fields(values), qpos, qvel, self._stribeck(values))

    def fields(self, values: Mapping[str, Scalar]) -> dict[str, PyTree]:
        """Return the fields of the compiled model that parameters set: field -> array."""
        s, model, dofs = self.servos, self.model, self._places[1]
        gear, full = np.array(s.gears, np.float32), s.sheet.full_rad
        gain, damping, inertia, friction, limit_rad, offset = (
            _each(values, name, s.names, otherwise)
            for name, otherwise in (*((name, None) for name in _NAMES), ("saturation", full), (OFFSET, 0.0))
        )
        # Motors and joints.
        motors = self._motors
        stiffness, most = gain * gear**2, gain * limit_rad * gear  # the torque limit is the torque at full duty
        numbers: dict[str, PyTree] = {n: jnp.asarray(getattr(model, n), jnp.float32) for n in _SET}
        numbers["actuator_gainprm"] = numbers["actuator_gainprm"].at[motors, 0].set(stiffness)
        bias = numbers["actuator_biasprm"].at[motors, 0].set(gain * offset * gear)
        numbers["actuator_biasprm"] = bias.at[motors, 1].set(-stiffness)
        limits = most[:, None] * jnp.array([-1.0, 1.0])
        numbers["actuator_forcerange"] = numbers["actuator_forcerange"].at[motors].set(limits)
        numbers["dof_damping"] = numbers["dof_damping"].at[dofs].set(damping * gear**2)
        armature = beside_damping(inertia, damping, self.step_s) * gear**2
        numbers["dof_armature"] = numbers["dof_armature"].at[dofs].set(armature)
        numbers["dof_frictionloss"] = numbers["dof_frictionloss"].at[dofs].set(friction * gear)
        if self.hand is None:
            return numbers
        # The payload: mass and centre of the link that holds it.
        link = int(model.jnt_bodyid[model.joint(self.hand.joint).id])
        mass, centre = float(model.body_mass[link]), np.asarray(model.body_ipos[link])
        payload = jnp.asarray(values.get(PAYLOAD, 0.0), jnp.float32)
        total = mass + payload
        middle = (mass * centre + payload * np.asarray(self.hand.at_m)) / total
        masses, centres = (jnp.asarray(x, jnp.float32) for x in (model.body_mass, model.body_ipos))
        return numbers | {"body_mass": masses.at[link].set(total), "body_ipos": centres.at[link].set(middle)}

    def exported(self, values: Mapping[str, Scalar]) -> Exported:
        # In MuJoCo add half a step for its leapfrog, as in the graph, and half a step because it uses the setpoints of
        # # a step's end. In the graph a goal acts as its mean over a tick, so a profile starts up to a tick early.
        late = Late(self.step_s - 0.25 * self.tick_s, self.servos.sheet.profile_rad_s)
        return Exported(converged(self._identified(values)), late, partial(self._plain, values))

    def _plain(self, values: Mapping[str, Scalar]) -> PlainSimulation:
        s, model, (qpos_at, qvel_at) = self.servos, self.model, self._places
        profiles = [min(s.sheet.profile_rad_s / gear, _NEVER) for gear in s.gears]
        numbers = {"profile_rad_s": np.array(profiles)}
        if (stribeck := self._stribeck(values)) is not None:
            widths = np.full(model.nv, _NEVER)
            widths[qvel_at] = np.minimum(np.asarray(stribeck), _NEVER)
            numbers["stribeck_rad_s"] = widths

        def begin(start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
            qpos[qpos_at], qvel[qvel_at] = np.split(start, 2)
            return qpos, qvel

        lead: dict[str, Any] = {"lead_s": self.lead_s, "velocity_lead_s": self.lead_s}
        mjcf = converged(self._identified(values))
        return PlainSimulation(mjcf, s.names, self.tick_s, begin, "setpoint", numbers, **lead)

    def following(self, values: Mapping[str, float]) -> Following:
        hand = self.hand
        loads = [{}] if hand is None else [{PAYLOAD: hand.least_kg}, {PAYLOAD: hand.most_kg}]
        return identified_following([self.exported({**values, **load}).mjcf for load in loads], self.servos.names)

    def twin(self, emulator: BusEmulation, **factors: float) -> Embedded:
        """Return an emulated robot with this model's physics.

        Args:
            emulator: Latencies and losses; the data sheet gives the servo model.
            **factors: Factors on the data sheet's ``gain``, ``damping``, ``armature`` and ``friction``.

        Raises:
            UsageError: A factor is unknown.
        """
        s, sheet = self.servos, self.servos.sheet
        if unknown := set(factors) - set(_NAMES):
            raise UsageError(f"a twin has no factor {min(unknown)!r}. Available: {', '.join(_NAMES)}")
        gain, damping, armature, friction = (getattr(sheet, n) * factors.get(n, 1.0) for n in _NAMES)
        worn = sheet.stribeck_rad_s is not None
        truth = {
            "gain": [gain * g**2 for g in s.gears],
            "limit": [gain * sheet.full_rad * g for g in s.gears],
            "damping": [damping * g**2 for g in s.gears],
            "damping_off": [damping * g**2 for g in s.gears],
            "armature": [armature * g**2 for g in s.gears],
            "friction": [0.0 if worn else friction * g for g in s.gears],
            "static": [friction * g if worn else 0.0 for g in s.gears],
            "stribeck_rad_s": [(sheet.stribeck_rad_s or 1.0) / g for g in s.gears],
        }
        arguments: dict[str, Any] = {
            "mjcf": self.mjcf.read_text(encoding="utf-8"),
            "joints": s.names,
            "servo_ids": s.ids,
            "truth": truth,
            "p_gain": sheet.p_gain,
            "names": [p.name for p in self.dynamics() if p.name != PAYLOAD],
            "gears": s.gears,
        }
        from sim2real.emulation.servo_plant import ServoPlant

        plant = partial(ServoPlant, **arguments)
        return Embedded(plant, replace(emulator, model_number=sheet.model_number))

    @cached_property
    def model(self) -> MjModel:
        """The compiled model at the data sheet's values."""
        return self._spec().compile()

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the joints' positions and velocities in the model."""
        numbers = [self.model.joint(name).id for name in self.servos.names]
        return self.model.jnt_qposadr[numbers], self.model.jnt_dofadr[numbers]

    @cached_property
    def _motors(self) -> np.ndarray:
        driven = self.model.actuator_trnid[:, 0].tolist()
        return np.array([driven.index(self.model.joint(name).id) for name in self.servos.names])

    def _stribeck(self, values: Mapping[str, Scalar]) -> PyTree:
        """Return for each joint the speed at which 1/e of its friction is left [rad/s]; None: constant friction."""
        if self.servos.sheet.stribeck_rad_s is None:
            return None
        gears = np.array(self.servos.gears, np.float32)
        return _each(values, "stribeck", self.servos.names, _NEVER) / gears

    def _spec(self, stops: bool = False) -> MjSpec:
        """Return the MJCF with a servo on each joint, and options that make its steps fast.

        Args:
            stops: Whether joints keep the ranges of the file; otherwise only the goals' limits keep the robot off its
                stops.
        """
        if not self.mjcf.is_file():
            raise UsageError(f"there is no model {self.mjcf}", hint="an MJCF file beside robot.py")
        spec: MjSpec = mj.MjSpec.from_file(str(self.mjcf))
        there, sheet = {joint.name for joint in spec.joints}, self.servos.sheet
        if lacking := [name for name in self.servos.names if name not in there]:
            raise UsageError(f"{self.mjcf} has no joint {lacking[0]!r}. Available: {', '.join(sorted(there))}")
        for name, gear in zip(self.servos.names, self.servos.gears, strict=True):
            joint: Any = spec.joint(name)
            joint.damping, joint.armature = [sheet.damping * gear**2, 0.0, 0.0], sheet.armature * gear**2
            joint.frictionloss, joint.solref_friction, joint.solimp_friction = sheet.friction * gear, _SOON, _STOPS
            joint.limited = joint.limited if stops else mj.mjtLimited.mjLIMITED_FALSE
            motor: Any = spec.add_actuator(name=f"{name}_servo", target=name, trntype=mj.mjtTrn.mjTRN_JOINT)
            stiffness = sheet.gain * gear**2
            motor.gaintype, motor.biastype = mj.mjtGain.mjGAIN_FIXED, mj.mjtBias.mjBIAS_AFFINE
            motor.gainprm[0], motor.biasprm[1] = stiffness, -stiffness
            motor.forcelimited, motor.forcerange = True, [-sheet.stall * gear, sheet.stall * gear]
        option = spec.option
        option.timestep, option.integrator = self.step_s, mj.mjtIntegrator.mjINT_IMPLICITFAST
        # One Newton step is 0.8 mrad off a hundred steps after two seconds, and makes training seven times as fast. But
        # # joints that friction should hold shiver, by 0.05 rad/s, and creep: a deployment takes more steps.
        option.iterations, option.ls_iterations = 1, 4
        option.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONTACT)
        return spec

    def _identified(self, values: Mapping[str, Scalar]) -> MjSpec:
        """Return the MJCF with identified values."""
        spec, numbers = self._spec(stops=True), {n: np.asarray(x, np.float64) for n, x in self.fields(values).items()}
        model = spec.compile()
        for name, array in numbers.items():
            if not name.startswith("body_"):
                getattr(model, name)[...] = array
        spec.copy_back(model)
        if self.hand is not None:
            # The centre of mass of a body changes, the inertia about it stays.
            link = int(model.jnt_bodyid[model.joint(self.hand.joint).id])
            body: Any = spec.body(model.body(link).name)
            body.explicitinertial, body.mass = True, float(numbers["body_mass"][link])
            body.ipos, body.iquat = numbers["body_ipos"][link], model.body_iquat[link]
            body.inertia, body.fullinertia = model.body_inertia[link], np.full(6, np.nan)
        return spec


_SET = (
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
    *("dof_damping", "dof_armature", "dof_frictionloss"),
)
"""Fields of the model that the servos' parameters set."""


def servo_parameters(sheet: DataSheet, joints: Sequence[str], own: Sequence[str] = ("friction",)) -> list[Parameter]:
    """Return gain, damping, rotor inertia and friction, bounded to factors of 3 to 10 of the data sheet.

    If friction decreases with speed, the width of this decrease, ``stribeck``, is a parameter. The temperature of
    grease and gears changes the friction of all joints.

    Args:
        own: Quantities with a value for each joint, named like ``friction_JOINT``; all joints share the others.
    """
    table = {
        "gain": ("N m/rad", sheet.gain, 3, "torque per error, at the P gain in use"),
        "damping": ("N m s/rad", sheet.damping, 4, "back-EMF, viscous friction"),
        "armature": ("kg m^2", sheet.armature, 4, "rotor behind the gears"),
        "friction": ("N m", sheet.friction, 8, "dry friction"),
        "stribeck": ("rad/s", sheet.stribeck_rad_s, 10, "speed at which 1/e of the dry friction is left"),
    }
    return [
        Parameter(
            label,
            unit,
            value,
            value / factor,
            value * factor,
            about=about,
            vanishes=name in _NAMES[1:],
            causes={"friction": 1.0} if name == "friction" else {},
        )
        for name, (unit, value, factor, about) in table.items()
        if value is not None
        for label in ([f"{name}_{joint}" for joint in joints] if name in own else [name])
    ]


def goal_offsets(joints: Sequence[str]) -> list[Parameter]:
    """Return the parameters for the offset of each servo from its goals, for ``dynamics``."""
    about, most = "rest position without load, from its goal", _MOST_OFFSET_RAD
    names = [f"{OFFSET}_{joint}" for joint in joints]
    return [Parameter(name, "rad", 0.0, -most, most, "linear", about=about) for name in names]


def _each(values: Mapping[str, Scalar], name: str, joints: Sequence[str], otherwise: float | None) -> PyTree:
    """Return the value for each joint ``(joints,)``: ``name_JOINT`` if it exists, otherwise the shared ``name``.

    Args:
        name: Such as ``gain``.
        otherwise: The value if neither exists; None: a missing value is an error.
    """
    shared = values.get(name, otherwise)
    entries = {f"{name}_{joint}": values.get(f"{name}_{joint}", shared) for joint in joints}
    if lacking := [label for label, value in entries.items() if value is None]:
        raise KeyError(lacking[0])
    return jnp.stack([jnp.asarray(value, jnp.float32) for value in entries.values()])


mj: Any = mujoco


def identified_following(mjcfs: Sequence[str], joints: Sequence[str]) -> Following:
    """Return how the joints of an identified model follow their goals.

    Args:
        mjcfs: The model with a position actuator on each joint: with the lightest payload, and with the heaviest.
        joints: Names of the joints, in the order of the servos.
    """
    models = [mj.MjModel.from_xml_string(mjcf) for mjcf in mjcfs]
    states, model = [mj.MjData(m) for m in models], models[0]
    places = [int(model.joint(joint).qposadr[0]) for joint in joints]
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    driven = model.actuator_trnid[:, 0].tolist()
    motors = [driven.index(int(model.joint(joint).id)) for joint in joints]
    stiffness = model.actuator_gainprm[motors, 0]
    friction_rad = model.dof_frictionloss[dofs] / stiffness
    most_rad = model.actuator_forcerange[motors, 1] / stiffness

    def weight(position_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sinks = []
        for m, data in zip(models, states, strict=True):
            data.qpos[places] = position_rad
            mj.mj_kinematics(m, data)
            mj.mj_comPos(m, data)
            mj.mj_crb(m, data)
            mj.mj_comVel(m, data)
            mj.mj_rne(m, data, 0, data.qfrc_bias)
            sinks.append(-data.qfrc_bias[dofs] / stiffness)
        return np.min(sinks, axis=0) - friction_rad, np.max(sinks, axis=0) + friction_rad

    damping = np.maximum(model.dof_damping[dofs], 1e-9)

    def speeds(position_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # On a long way, a joint reaches at least a share of the speed at which damping takes the torque that weight and
        # # friction leave.
        lowest, highest = weight(position_rad)
        left = most_rad - np.maximum(highest, 0.0), most_rad + np.minimum(lowest, 0.0)
        downwards, upwards = (np.clip(_SHARE * rad * stiffness / damping, _LEAST_RAD_S, None) for rad in left)
        return downwards, upwards

    return Following(LIMIT_RAD, RESPONSE_S, source="the identified model", weight=weight, speeds=speeds)
