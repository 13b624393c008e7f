"""The world of a servo robot in simulation; sensor and actuator are in ``simulated_devices.py``."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, Value
from sim2real.robots.loop import ACTUATOR
from sim2real.robots.messages import JointReading
from sim2real.robots.nodes import SimActuator, SimSensor
from sim2real.robots.servo.parameters import STRIBECK
from sim2real.robots.servo.parts import REFERENCE, GoalTask
from sim2real.types import Array, Key, PyTree
from sim2real.worlds.composed import ComposedWorld, WorldParams
from sim2real.worlds.worn import WornFriction

__all__ = ["ServoWorld", "SimActuator", "SimSensor"]


class ServoWorld(ComposedWorld):
    """A composed task as a world: its input from the actuator has the joints' goals, its output their measured motion.

    Args:
        parameters: Parts of the model that differ between copies: name -> (elements, attribute).
        resumed: Whether episodes begin in the middle of a recording. The servos' setpoints, which are not recorded,
            then start at the goals of that time; otherwise they start at the joints' positions, as when torque goes on.
        worn: Whether dry friction decreases with speed; the parameter ``stribeck_rad_s`` is the speed at which 1/e of
            it is left.
        **options: Options of ``ComposedWorld``.
    """

    def __init__(
        self,
        name: str,
        task: GoalTask,
        parameters: Mapping[str, tuple[PyTree, str]],
        resumed: bool = False,
        actuator: str = ACTUATOR,
        worn: bool = False,
        **options: Any,
    ) -> None:
        if worn and options.get("impl", "jax") != "jax":
            raise UsageError("friction that decreases with speed is set between MJX's steps", hint='set impl="jax"')
        super().__init__(name, task, actuator, "goal", parameters, **options)
        self._resumed = resumed
        self.law = WornFriction() if worn else None
        self.lead_s = 0.5 * task.physics_timestep
        model = self.environment.model
        joints = [model.joint(j.full_identifier) for j in task.joints]
        self._qpos = jnp.array([int(j.qposadr[0]) for j in joints])
        self._qvel = jnp.array([int(j.dofadr[0]) for j in joints])

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> WorldParams:
        """Return the parameters' compiled values; friction then is the same at every speed."""
        params = super().init_params(rng, graph_state)
        if self.law is None:
            return params
        return params.replace(values={**params.values, STRIBECK: jnp.full(len(self._qvel), jnp.inf)})

    def law_values(self, params: WorldParams) -> dict[str, jax.Array]:
        """Return friction at standstill [N m], and the speed [rad/s] at which 1/e of it is left, of each joint."""
        friction = self._model(params).dof_frictionloss
        widths = jnp.full(friction.shape, jnp.inf).at[self._qvel].set(jnp.asarray(params.values[STRIBECK]))
        return {"frictionloss": friction, STRIBECK: widths}

    def output(self, state: PyTree) -> JointReading:
        """Return positions and velocities of the joints."""
        # In a leapfrog scheme velocities belong to half a step earlier: extrapolated by the acceleration.
        speed = state.data.qvel + self.lead_s * state.data.qacc
        return JointReading(state.data.qpos[self._qpos], speed[self._qvel])

    def velocity(self, state: PyTree) -> jax.Array:
        """Return the joints' velocities ``(joints,)`` [rad/s]."""
        return state.data.qvel[self._qvel]

    def with_velocity(self, state: PyTree, velocity: jax.Array) -> PyTree:
        """Return the state with other velocities of the joints ``(joints,)`` [rad/s]."""
        return state.replace(data=state.data.replace(qvel=state.data.qvel.at[self._qvel].set(velocity)))

    def entered(self, state: PyTree, action: Array) -> PyTree:
        """Return the state with which a control step begins; a resumed episode's setpoints start at the goals.

        Args:
            action: The newest goals ``(joints,)`` [rad].
        """
        if not self._resumed:
            return state
        reference = jnp.where(state.steps == 0, action, state.variables[REFERENCE])
        return state.replace(variables={**state.variables, REFERENCE: reference})

    def init_delays(self, rng: Key | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the delay of the goals, if the actuator's parameters have one.

        MuJoCo's integrator (a leapfrog scheme) moves a joint as if a force had acted half a time step earlier. Half a
        step is therefore added to the delay, so that an identified delay is that of the real robot.
        """
        delays = super().init_delays(rng, graph_state)
        return {name: delay + self.lead_s for name, delay in delays.items()}
