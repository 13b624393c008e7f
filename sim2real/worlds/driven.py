"""A MuJoCo model whose joints have drives, which recorded commands move."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.types import MjModel, PyTree, Scalar
from sim2real.worlds.closing import Closing
from sim2real.worlds.drive_terms import DriveLaw, DriveTerms
from sim2real.worlds.mjx import MjxParams, MjxWorld
from sim2real.worlds.recorded import delay_of

if TYPE_CHECKING:
    from sim2real.graph.base import Value


PAYLOAD = "sim2real_payload"
"""Name of the body that is a log's payload."""
OF_PAYLOAD = {"payload": "kg", "payload_reach": "m"}
"""Fields of commands that describe the payload -> units."""


@pytree.dataclass
class DriveCommand(Base):
    """Command of the drives; each entry has shape ``(joints,)`` or ``(1,)``, or is None if the log lacks it.

    Attributes:
        goal: Goal position, by the encoder [rad].
        goal_velocity: Goal velocity [rad/s].
        torque: Feed-forward torque; without a goal, the whole torque [N m].
        duty: The voltage, or a quantity proportional to it.
        kp: Stiffness, in the log's unit.
        kd: Damping, in the log's unit.
        enabled: 1 with torque on, 0 with torque off.
        volts: Measured supply voltage [V]; 0: unknown.
        payload: Mass of the payload, constant in a log [kg].
        payload_reach: Distance of the payload from the origin of its body, towards the body's centre of mass [m].
    """

    goal: Value | None = None
    goal_velocity: Value | None = None
    torque: Value | None = None
    duty: Value | None = None
    kp: Value | None = None
    kd: Value | None = None
    enabled: Value | None = None
    volts: Value | None = None
    payload: Value | None = None
    payload_reach: Value | None = None


@pytree.dataclass
class DriveParams(MjxParams):
    """Parameters of drives, each of shape ``(joints,)``, in addition to the model's.

    The force is ``kp * (goal - angle) + kd * (goal_velocity - velocity) + gain * (torque or duty)``, within the model's
    limits (``jnt_actfrcrange``).

    Attributes:
        kp: Stiffness [N m/rad], or the factor on the log's stiffness.
        kd: Damping of the drive [N m s/rad], or the factor on the log's damping.
        gain: Torque for each unit of torque or duty.
        released: Share of the drive's damping with torque off, by short-circuited windings.
        zero: Reading of the encoders at the model's zero [rad].
        voltage: Share of stiffness and gain that is proportional to the supply voltage.
        terms: Further terms of friction and drive; None: none.
    """

    kp: Value = 0.0
    kd: Value = 0.0
    gain: Value = 1.0
    released: Value = 0.0
    zero: Value = 0.0
    voltage: Value = 0.0
    terms: DriveTerms | None = None


class DrivenWorld(MjxWorld):
    """A model with a drive on each joint that was recorded.

    A drive consists of three actuators, made by ``sim2real.robots.model.drives.driven``: force, stiffness and damping,
    whose values are the controls. So gains may change from tick to tick and act at every time step, and damping is
    implicit.

    Args:
        rate: Ticks per second [Hz].
        units: One unit of the log's ``kp`` [N m/rad] and ``kd`` [N m s/rad], and the usual supply voltage [V].
        terms: Whether there are ``DriveTerms``: they are evaluated before every physics step.
        **options: Options of ``MjxWorld``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        model: MjModel,
        units: tuple[float, float, float] = (1.0, 1.0, 1.0),
        terms: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(name, rate, model, **options)
        self.units = units
        self.joints = np.array(model.actuator_trnid[: model.nu // 3, 0])
        self.qpos_at, self.qvel_at = model.jnt_qposadr[self.joints], model.jnt_dofadr[self.joints]
        self._others = np.setdiff1d(np.arange(model.nv), self.qvel_at)
        self.law = DriveLaw(self.qpos_at, self.qvel_at, self._others) if terms else None
        self._closing = Closing(model, self.qpos_at, self.qvel_at) if len(self._others) else None
        self.lead_s = 0.5 * float(model.opt.timestep)

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> DriveParams:
        """Return the model at its reference, with drives of gain 0."""
        params = super().init_params(rng, graph_state)
        zero = jnp.zeros(len(self.joints))
        off = DriveTerms()
        terms = off.replace(**{f.name: zero + getattr(off, f.name) for f in fields(off)}) if self.law else None
        return DriveParams(params.model, params.qpos, params.qvel, terms=terms)

    def holding(self, params: DriveParams, command: DriveCommand) -> DriveParams:
        """Return parameters with the payload of a command."""
        if command.payload is None:
            return params
        fields, at = params.model, self.model.body(PAYLOAD).id
        mass = jnp.asarray(fields.body_mass).at[at].add(jnp.ravel(command.payload)[0])
        changed: dict[str, PyTree] = {"body_mass": mass}
        if command.payload_reach is not None:
            place = payload_place(self.model, jnp.ravel(command.payload_reach)[0])
            changed["body_pos"] = jnp.asarray(fields.body_pos).at[at].set(place)
        return params.replace(model=fields.tree_replace(changed))

    def law_values(self, params: DriveParams) -> dict[str, jax.Array]:
        """Return the values of the law: friction and limits of the model, and the coefficients of the terms."""
        model, still = params.model, jnp.zeros(len(self.joints))
        drives = {
            "damping": model.dof_damping[self.qvel_at],
            "frictionloss": model.dof_frictionloss[self.qvel_at],
            "limit": jnp.asarray(model.jnt_actfrcrange)[self.joints, 1],
        }
        coefficients = {f.name: getattr(params.terms, f.name) for f in fields(DriveTerms)}
        others = {
            "other_damping": jnp.asarray(model.dof_damping)[self._others],
            "other_frictionloss": jnp.asarray(model.dof_frictionloss)[self._others],
        }
        return {n: still + v for n, v in (drives | coefficients).items()} | others

    def started(self, params: DriveParams, angle: jax.Array, speed: jax.Array) -> DriveParams:
        """Return parameters with an initial state; equalities determine the joints that were not recorded.

        Args:
            angle: Shape ``(joints,)``: angles angles of the recorded joints, from the model's zero [rad or m].
            speed: Shape ``(joints,)`` [rad/s or m/s].
        """
        if self._closing:
            qpos, qvel = self._closing(angle, speed)
        else:
            qpos, qvel = params.qpos.at[self.qpos_at].set(angle), params.qvel.at[self.qvel_at].set(speed)
        return params.replace(qpos=qpos, qvel=qvel)

    def gaps(self, angles: np.ndarray) -> np.ndarray:
        """Return the closing error of the model's loops at positions ``(N, joints)``, ``(N,)`` [m or rad]."""
        if not self._closing:
            return np.zeros(len(angles))
        return np.asarray(jax.jit(jax.vmap(self._closing.gap))(jnp.asarray(angles)))

    def init_delays(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the delay of the commands, if the actuator's parameters set one.

        Half a time step is added, because MuJoCo's integrator moves joints as if a force had acted that much earlier.
        """
        del rng
        delays = delay_of(self.input_name, self.input_name, graph_state)
        return {name: delay + self.lead_s for name, delay in delays.items()}

    def _control(self, step_state: StepState) -> jax.Array:
        """Return forces, stiffnesses and dampings, ``(3 * joints,)``, for the newest command.

        With terms, ``(5 * joints,)``: followed by 1 (torque on) or 0 (torque off), and the goals.
        """
        # The gains: the parameters times the log's gains.
        p: DriveParams = step_state.params
        command: DriveCommand = step_state.inputs[self.input_name][-1].data
        still = jnp.zeros(len(self.joints))
        on = still + 1.0 if command.enabled is None else jnp.asarray(command.enabled) + still
        # A motor's torque at a duty is proportional to its supply voltage.
        usual = jnp.ones(1) if command.volts is None else jnp.asarray(command.volts) / self.units[2]
        strength = 1.0 + p.voltage * (jnp.where(usual > 0.0, usual, 1.0) - 1.0)
        kp = still if command.goal is None else on * strength * p.kp * _of_log(command.kp, self.units[0])
        kd = p.kd * _of_log(command.kd, self.units[1]) * (on + (1.0 - on) * p.released) + still
        # The force without the parts that depend on the state.
        goal = still if command.goal is None else command.goal - p.zero + still
        force = kp * goal
        force += still if command.goal_velocity is None else on * kd * command.goal_velocity
        for pushed in (command.torque, command.duty):
            force += still if pushed is None else on * strength * p.gain * pushed
        return jnp.concatenate([force, kp, kd, *([on, goal] if self.law else [])])


def _of_log(gain: Value | None, unit: float) -> Value:
    """Return the log's gain in SI units; 1 without a gain."""
    return 1.0 if gain is None else gain / unit


def payload_place(model: MjModel, reach: Scalar) -> PyTree:
    """Return where a payload is in the frame of the body that holds it, ``(3,)`` [m]."""
    middle = model.body(PAYLOAD).pos
    return reach * middle / np.linalg.norm(middle)
