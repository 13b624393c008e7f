"""The world of a servo robot for recorded commands on C MuJoCo, without JAX: numpy's arrays of copies."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.hooks import Hooks
from sim2real.composer.physics import layout
from sim2real.composer.physics.c.physics import Physics
from sim2real.composer.variation.variators import CONSTANTS
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseWorld
from sim2real.installation import has_jax
from sim2real.robots.loop import delay_of
from sim2real.robots.messages import JointReading
from sim2real.robots.servo.parameters import STRIBECK
from sim2real.robots.servo.parts import REFERENCE, GoalTask
from sim2real.types import Key, MjModel, PyTree
from sim2real.worlds.rollouts import Start, WorldParams
from sim2real.worlds.worn import WornFriction

if TYPE_CHECKING:
    from sim2real.graph.base import Value
    from sim2real.robots.servo.simulated_world import ServoWorld

Parameters = Mapping[str, tuple[PyTree, str]]


def servo_world(
    name: str, task: GoalTask, parameters: Parameters, resumed: bool, actuator: str, worn: bool
) -> ServoWorld | PlainServoWorld:
    """Return the world of a servo robot, without JAX one for recorded commands; see the arguments of ``ServoWorld``."""
    if not has_jax():
        return PlainServoWorld(name, task, parameters, actuator, worn)
    from sim2real.robots.servo.simulated_world import ServoWorld  # MJX

    return ServoWorld(name, task, parameters, resumed, actuator, worn)


class PlainServoWorld(BaseWorld):
    """A ``ServoWorld`` of resumed episodes whose physics runs outside of the graph; see ``OpenLoop``."""

    def __init__(self, name: str, task: GoalTask, parameters: Parameters, actuator: str, worn: bool) -> None:
        super().__init__(name, 1.0 / task.control_timestep)
        self.input_name, self.law = actuator, WornFriction() if worn else None
        self.lead_s, self.substeps = 0.5 * task.physics_timestep, task.physics_steps_per_control_step
        self.derives = any(attribute in CONSTANTS for _, attribute in parameters.values())
        self._hooks, random_state = Hooks(task), np.random.RandomState(0)
        self._hooks.run("initialize_episode_mjcf", random_state)
        self._hooks.refresh()
        self.model: MjModel = task.root_entity.mjcf_model.root_model.compile()
        # Run the hooks of a start for the variables that they leave.
        physics = Physics(copy.copy(self.model))
        self._hooks.run("after_compile", physics, random_state)
        self._hooks.run("initialize_episode", physics, random_state)
        pairs = ((n, getattr(self.model, n), getattr(physics.model.ptr, n)) for n in layout.array_fields("model"))
        if changed := [n for n, before, after in pairs if np.asarray(before).tobytes() != np.asarray(after).tobytes()]:
            raise UsageError(f"hooks set {changed[0]} at the start", hint="use the compiled engine")
        self._variables, self._warmstart = dict(physics.variables), physics.data.ptr.qacc_warmstart.copy()
        self._places = {n: physics.bind(elements).locate(attribute) for n, (elements, attribute) in parameters.items()}
        joints = [self.model.joint(j.full_identifier) for j in task.joints]
        self._qpos, self._qvel = (
            [int(at[0]) for at in c] for c in zip(*((j.qposadr, j.dofadr) for j in joints), strict=True)
        )

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> WorldParams:
        """Return the parameters' compiled values; friction then is the same at every speed."""
        values = {n: np.array(getattr(self.model, f.name)[index]) for n, (f, index) in self._places.items()}
        return WorldParams(values | ({STRIBECK: np.full(len(self._qvel), np.inf)} if self.law else {}))

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the variables of the hooks."""
        return self._variables

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> JointReading:
        """Return zeros."""
        return JointReading(np.zeros(len(self._qpos)), np.zeros(len(self._qpos)))

    def init_delays(self, rng: Key | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the delay of the goals; see ``ServoWorld``."""
        delays = delay_of(self.input_name, self.input_name, graph_state)
        return {name: delay + self.lead_s for name, delay in delays.items()}

    def open_loop(self) -> MjModel:
        """Return the ``MjModel``."""
        return self.model

    def fields(self, params: WorldParams, state: PyTree) -> dict[str, np.ndarray]:
        """Return the fields of the model that parameters set, ``(..., n)``."""
        fields: dict[str, np.ndarray] = {}
        for name, (field, index) in self._places.items():
            whole, value = getattr(self.model, field.name), np.asarray(params.values[name])
            shape = (*value.shape[: value.ndim - whole[index].ndim], *whole.shape)
            before: PyTree = fields.get(field.name, whole)
            changed = np.array(np.broadcast_to(before, np.broadcast_shapes(before.shape, shape)))
            places = index if isinstance(index, tuple) else (index,)
            changed[(*[slice(None)] * (changed.ndim - whole.ndim), *places)] = value
            fields[field.name] = changed
        return fields

    def law_values(self, params: WorldParams) -> dict[str, np.ndarray]:
        """Return friction at standstill [N m], and the speed [rad/s] at which 1/e of it is left, ``(..., nv)``."""
        friction = self.fields(params, None)["dof_frictionloss"]
        widths = np.full(friction.shape, np.inf)
        widths[..., self._qvel] = params.values[STRIBECK]
        return {"frictionloss": friction, STRIBECK: widths}

    def start(self, params: WorldParams, state: PyTree) -> Start:
        """Return where the physics starts."""
        return Start(np.asarray(params.qpos), np.asarray(params.qvel), self._warmstart)

    def controls(self, step_state: StepState) -> tuple[StepState, np.ndarray]:
        """Run the hooks of a tick; return the controls of its physics steps ``(..., substeps, nu)``."""
        goal, variables = step_state.inputs[self.input_name].data.goal[-1], dict(step_state.state)
        first = np.equal(step_state.seq, 0)[..., None]
        variables[REFERENCE] = np.where(first, goal, variables[REFERENCE])  # see ServoWorld.entered
        # Hooks see no state: they compute controls from goals.
        controls: list[np.ndarray] = []
        step_s, keep = lambda: float(self.model.opt.timestep), controls.append
        physics = SimpleNamespace(np=np, variables=variables, timestep=step_s, set_control=keep)
        self._hooks.run("before_step", physics, goal, None)
        for _ in range(self.substeps):
            self._hooks.run("before_substep", physics, goal, None)
        return step_state.replace(state=variables), np.stack(controls, axis=-2)

    def message(self, state: PyTree, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray) -> JointReading:
        """Return positions and velocities of the joints; see ``ServoWorld.output``."""
        return JointReading(qpos[..., self._qpos], (qvel + self.lead_s * qacc)[..., self._qvel])
