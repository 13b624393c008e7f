"""Parts of worlds: a position-controlled servo, robots driven by such, and tasks whose action is their goals."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim2real.composer import mjcf
from sim2real.composer.robot import Robot
from sim2real.composer.task import Task
from sim2real.robots.datasheet import DataSheet

GOAL, REFERENCE = "goal", "reference"
"""Variables of the physics: where the servos are told to be, and where their profile has come ``(joints,)`` [rad]."""


class Servo(Robot):
    """A position-controlled servo: torque = gain * (reference - angle), and no more than the stall torque.

    Back-EMF and viscous friction together are the joint's damping. What it drives is attached to ``horn``.

    Args:
        name: Of the model.
        axis: About which the horn turns.
        sheet: Its numbers.
    """

    def _build(self, name: str, axis: tuple[float, float, float], sheet: DataSheet) -> None:
        self._model = mjcf.RootElement(model=name)
        horn = self._model.worldbody.add("body", name="horn")
        self.joint = horn.add(
            "joint",
            name="joint",
            axis=axis,
            damping=sheet.damping,
            armature=sheet.armature,
            frictionloss=sheet.friction,
        )
        self.horn = horn.add("site", name="horn")
        most = (-sheet.stall, sheet.stall)
        self.actuator = self._model.actuator.add(
            "position", name="motor", joint=self.joint, kp=sheet.gain, forcerange=most, forcelimited=True
        )
        self.profile_rad_s = sheet.profile_rad_s

    @property
    def mjcf_model(self) -> Any:
        """The model."""
        return self._model

    @property
    def actuators(self) -> list[Any]:
        """The motor."""
        return [self.actuator]


class ServoDriven(Robot):
    """A robot of servos. As their firmware does, it moves each reference to its goal no faster than the profile allows.

    Subclasses fill ``servos`` when they build their model; the action is one goal a servo, in their order.

    Attributes:
        servos: The servos.
    """

    servos: tuple[Servo, ...] = ()

    @property
    def joints(self) -> list[Any]:
        """The joints of the servos."""
        return [s.joint for s in self.servos]

    @property
    def actuators(self) -> list[Any]:
        """The motors of the servos."""
        return [s.actuator for s in self.servos]

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Hold the joints where they are."""
        del random_state
        here = physics.np.array(physics.bind(self.joints).qpos)
        physics.variables[GOAL], physics.variables[REFERENCE] = here, here

    def before_substep(self, physics: Any, random_state: Any) -> None:
        """Move the references towards the goals."""
        del random_state
        most = np.array([s.profile_rad_s for s in self.servos]) * physics.timestep()
        before = physics.variables[REFERENCE]
        move = physics.np.clip(physics.variables[GOAL] - before, -most, most)
        physics.variables[REFERENCE] = before + move
        # Its mean over the step. With its end the arm of pipelines/arm was 2 to 4 mrad off a simulation in steps a
        # fifth as long, and half a step early; so it is 0.4 to 1.2 mrad off.
        physics.set_control(before + move * (1.0 - 0.5 * physics.np.abs(move) / most))


class GoalTask(Task):
    """A task for one ``ServoDriven`` robot, the only one in its world that is driven: the action is its goals [rad]."""

    robot: ServoDriven

    @property
    def joints(self) -> list[Any]:
        """The joints of the robot's servos."""
        return self.robot.joints

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
        """Take the goals ``(joints,)`` [rad]."""
        del random_state
        physics.variables[GOAL] = physics.np.asarray(action)
