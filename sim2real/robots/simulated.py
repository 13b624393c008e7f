"""The nodes of a servo robot in simulation: its world; its sensor and actuator are those of any robot."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sim2real.composer.world import ComposedWorld
from sim2real.graph.base import GraphState, StepState
from sim2real.robots.devices import SimActuator, SimSensor
from sim2real.robots.loop import delay_of
from sim2real.robots.messages import JointReading
from sim2real.robots.parts import REFERENCE, GoalTask

__all__ = ["ServoWorld", "SimActuator", "SimSensor"]


class ServoWorld(ComposedWorld):
    """A composed task whose joints are told where to be by the ``actuator`` input, and which shows where they are.

    Args:
        name: Unique in the graph.
        task: The task.
        parameters: What differs from copy to copy: name -> (elements, attribute).
        resumed: Whether episodes begin in the middle of a recording: the servos' references, which nobody measured,
            then begin at the goals of that time. Otherwise they begin where the joints are, as torque goes on.
        **options: As of ``ComposedWorld``.
    """

    def __init__(self, name: str, task: GoalTask, parameters: Any, resumed: bool = False, **options: Any) -> None:
        super().__init__(name, task, "actuator", "goal", parameters, **options)
        self._resumed = resumed
        self.lead_s = 0.5 * task.physics_timestep
        model = self.environment.model
        joints = [model.joint(j.full_identifier) for j in task.joints]
        self._qpos = jnp.array([int(j.qposadr[0]) for j in joints])
        self._qvel = jnp.array([int(j.dofadr[0]) for j in joints])

    def output(self, state: Any) -> JointReading:
        """Return where the joints are, and how fast."""
        # A leapfrog's speeds are those of half a step ago.
        speed = state.data.qvel + self.lead_s * state.data.qacc
        return JointReading(state.data.qpos[self._qpos], speed[self._qvel])

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Take a control step under the newest goals."""
        if self._resumed:
            state, goal = step_state.state, step_state.inputs["actuator"][-1].data.goal
            reference = jnp.where(state.steps == 0, goal, state.variables[REFERENCE])
            state = state.replace(variables={**state.variables, REFERENCE: reference})
            step_state = step_state.replace(state=state)  # pyright: ignore[reportAttributeAccessIssue]
        return super().step(step_state)

    def init_delays(self, rng: Any = None, graph_state: GraphState | None = None) -> dict[str, Any]:
        """Return the delay of the goals, where the actuator's parameters set one.

        MuJoCo's step moves a joint as if its force had acted since half a step earlier (a leapfrog): that much is
        added, so that a delay that is fitted with it is the robot's.
        """
        del rng
        found = delay_of("actuator", "actuator", graph_state)
        return {name: delay + self.lead_s for name, delay in found.items()}
