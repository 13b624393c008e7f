"""The world of a servo arm: an MJCF on MJX, whose setpoints move to their goals with limited speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.composer.physics.mjx import constants, gate, stepping
from sim2real.composer.physics.mjx.import_mjx import mjx
from sim2real.graph.base import Base, Empty, GraphState, StepState, Value
from sim2real.graph.node import BaseWorld
from sim2real.robots.loop import ACTUATOR, WORLD
from sim2real.robots.messages import JointReading
from sim2real.types import MjModel, PyTree
from sim2real.worlds.recorded import delay_of
from sim2real.worlds.rollouts import Start, WornFriction

if TYPE_CHECKING:
    from sim2real.types import Array


@pytree.dataclass
class ServoParams(Base):
    """Parameters of an episode.

    Attributes:
        fields: Field of the model -> its values.
        qpos: Positions at the start ``(nq,)`` [rad].
        qvel: Velocities at the start ``(nv,)`` [rad/s].
        stribeck_rad_s: Speed at which 1/e of the dry friction is left, ``(joints,)`` [rad/s]; None: friction is
            constant.
    """

    fields: dict[str, Any]
    qpos: Any
    qvel: Any
    stribeck_rad_s: Any = None


@pytree.dataclass
class ServoState(Base):
    """The state of the world.

    Attributes:
        data: ``mjx.Data``.
        reference: Setpoints of the servos' position controllers ``(joints,)`` [rad].
        derived: Constants that follow from the parameters, by field of the model.
        places: Indices of the joints' positions and velocities.
    """

    data: Any
    reference: Any
    derived: dict[str, Any]
    places: tuple[tuple[int, ...], tuple[int, ...]] = pytree.field(pytree_node=False)

    @property
    def position(self) -> Any:
        """Positions of the joints ``(joints,)`` [rad]."""
        return self.data.qpos[np.array(self.places[0])]

    @property
    def velocity(self) -> Any:
        """Velocities of the joints ``(joints,)`` [rad/s]."""
        return self.data.qvel[np.array(self.places[1])]

    @property
    def time_s(self) -> Any:
        """Time from the episode's start [s]."""
        return self.data.time


class ServoWorld(BaseWorld):
    """Position servos: torque = gain * (setpoint - angle), within a limit; the actuator's messages have the goals.

    In MuJoCo's leapfrog scheme a force acts half a time step early, and velocities are half a step old. So half a step
    is added to the delay of the goals, and measured velocities are extrapolated by it: an identified delay is the
    robot's.

    Args:
        model: Model with one position actuator for each joint.
        joints: Names of the servos' joints.
        profile_rad_s: Largest speeds of the setpoints ``(joints,)``.
        resumed: Whether episodes begin in the middle of a recording. Then the setpoints, which are not recorded, start
            at the goals of that time; otherwise at the joints' positions, as when torque goes on.
        worn: Whether dry friction decreases with speed.
    """

    def __init__(
        self,
        model: MjModel,
        joints: Sequence[str],
        tick_s: float,
        profile_rad_s: Sequence[float],
        resumed: bool = False,
        worn: bool = False,
    ) -> None:
        super().__init__(WORLD, 1.0 / tick_s)
        gate.check_model(model)
        self.model, self.input_name, self._resumed = model, ACTUATOR, resumed
        step_s = float(model.opt.timestep)
        self.substeps, self.lead_s, self.derives = round(tick_s / step_s), 0.5 * step_s, True
        self.law = WornFriction() if worn else None
        numbers = [model.joint(name).id for name in joints]
        self.qpos_at, self.qvel_at = model.jnt_qposadr[numbers], model.jnt_dofadr[numbers]
        driven = model.actuator_trnid[:, 0].tolist()
        self._motors = np.array([driven.index(number) for number in numbers])
        self._reach = np.asarray(profile_rad_s, np.float32) * np.float32(step_s)
        self._mjx_model, self._apart = mjx.put_model(model, impl="jax"), False

    def solve_to_rest(self) -> None:
        """Use many iterations of the solver: with few, joints creep that friction should hold."""
        option = self._mjx_model.opt.replace(iterations=6, ls_iterations=20)
        self._mjx_model = self._mjx_model.replace(opt=option)

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> ServoParams:
        return ServoParams({}, jnp.asarray(self.model.qpos0, jnp.float32), jnp.zeros(self.model.nv))

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> ServoState:
        params = self._params(graph_state)
        reference, places = (
            jnp.asarray(params.qpos)[self.qpos_at],
            (tuple(map(int, self.qpos_at)), tuple(map(int, self.qvel_at))),
        )
        if self._apart:
            return ServoState(Empty(), reference, {}, places)
        model = stepping.with_fields(self._mjx_model, dict(params.fields))
        derived = constants.derive(self.model, model) if params.fields else {}
        model = self._worn(stepping.with_fields(model, derived), params, jnp.asarray(params.qvel))
        data = mjx.make_data(self.model, impl="jax").replace(
            qpos=jnp.asarray(params.qpos), qvel=jnp.asarray(params.qvel)
        )
        return ServoState(stepping.JaxEngine().forward(model, data, actuation=False), reference, derived, places)

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> JointReading:
        if self._apart:
            params = self._params(graph_state)
            return JointReading(jnp.asarray(params.qpos)[self.qpos_at], jnp.asarray(params.qvel)[self.qvel_at])
        state = (graph_state or GraphState()).state.get(self.name)
        data = (self.init_state(rng, graph_state) if state is None else state).data
        return self.message(None, data.qpos, data.qvel, data.qacc)

    def init_delays(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        delays = delay_of(ACTUATOR, ACTUATOR, graph_state)
        return {name: delay + self.lead_s for name, delay in delays.items()}

    def step(self, step_state: StepState) -> tuple[StepState, JointReading]:
        params, state = step_state.params, step_state.state
        model = stepping.with_fields(self._mjx_model, {**params.fields, **state.derived})
        step_state, controls = self.controls(step_state)

        def once(data: PyTree, control: jax.Array) -> tuple[PyTree, None]:
            now = self._worn(model, params, data.qvel)
            return stepping.JaxEngine().advance(
                now, data.replace(ctrl=control.astype(data.ctrl.dtype)), legacy=False
            ), None

        data = jax.lax.scan(once, state.data, controls)[0]
        new = step_state.state.replace(data=data)
        return step_state.replace(state=new), self.message(None, data.qpos, data.qvel, data.qacc)

    def true_state(self, state: ServoState) -> PyTree:
        """Return the part of the state that a value function may observe."""
        return state.data.qpos, state.data.qvel, state.reference

    def velocity(self, state: ServoState) -> jax.Array:
        """Return the joints' velocities ``(joints,)`` [rad/s]."""
        return state.velocity

    def with_velocity(self, state: ServoState, velocity: jax.Array) -> ServoState:
        """Return the state with other velocities of the joints ``(joints,)`` [rad/s]."""
        data = state.data
        return state.replace(data=data.replace(qvel=data.qvel.at[self.qvel_at].set(velocity)))

    def law_values(self, params: ServoParams) -> dict[str, jax.Array]:
        """Return friction at standstill [N m], and the speed at which 1/e of it is left [rad/s], each ``(nv,)``."""
        friction = jnp.asarray(params.fields.get("dof_frictionloss", self.model.dof_frictionloss))
        widths = jnp.full(friction.shape, jnp.inf)
        if params.stribeck_rad_s is not None:
            widths = widths.at[self.qvel_at].set(jnp.asarray(params.stribeck_rad_s))
        return {"frictionloss": friction, "stribeck_rad_s": widths}

    def _worn(self, model: PyTree, params: ServoParams, qvel: jax.Array) -> PyTree:
        if self.law is None:
            return model
        friction = self.law(jnp, self.law_values(params), qvel, qvel, qvel)[2]["dof_frictionloss"]
        return stepping.with_fields(model, {"dof_frictionloss": jnp.asarray(friction, model.dof_frictionloss.dtype)})

    def _params(self, graph_state: GraphState | None) -> ServoParams:
        return (graph_state or GraphState()).params.get(self.name) or self.init_params()

    # -- physics that runs elsewhere, see ``worlds.rollouts``

    def open_loop(self) -> MjModel:
        """Switch the node's physics off, and return the ``MjModel``."""
        self._apart = True
        return self.model

    def fields(self, params: ServoParams, state: PyTree) -> dict[str, Any]:
        """Return the fields of the model that parameters set."""
        return dict(params.fields)

    def start(self, params: ServoParams, state: PyTree) -> Start:
        """Return where the physics starts."""
        return Start(jnp.asarray(params.qpos), jnp.asarray(params.qvel), jnp.zeros(self.model.nv))

    def controls(self, step_state: StepState) -> tuple[StepState, jax.Array]:
        """Return the step state with the setpoints a tick later, and the controls ``(substeps, nu)``.

        A control is the mean of the setpoint over its time step. Compared with steps a fifth as long, the arm of
        pipelines/arm is then off by 0.4 to 1.2 mrad; with the setpoint at the step's end, by 2 to 4 mrad.
        """
        goal, reference = step_state.inputs[self.input_name].data.goal[-1], step_state.state.reference
        if self._resumed:
            reference = jnp.where(step_state.seq == 0, goal, reference)
        rows, reach = [], self._reach
        for _ in range(self.substeps):
            move = jnp.clip(goal - reference, -reach, reach)
            rows.append(reference + move * (1.0 - 0.5 * jnp.abs(move) / reach))
            reference = reference + move
        controls = jnp.zeros((self.substeps, self.model.nu)).at[:, self._motors].set(jnp.stack(rows))
        return step_state.replace(state=step_state.state.replace(reference=reference)), controls

    def message(self, state: PyTree, qpos: Array, qvel: Array, qacc: Array) -> JointReading:
        """Return positions and velocities of the joints."""
        speed = qvel + self.lead_s * qacc
        return JointReading(qpos[self.qpos_at], speed[self.qvel_at])
