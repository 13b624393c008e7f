"""Parts of composed worlds: position-controlled servos, robots made of them, and tasks that command their goals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from dm_env import specs

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.robot import Robot
from sim2real.composer.task import Task
from sim2real.robots.servo.datasheet import DataSheet
from sim2real.robots.servo.servos import gear_of, name_of
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.hardware.joint import Joint

GOAL, REFERENCE = "goal", "reference"
"""Variables of the physics, each ``(joints,)`` [rad]: the goal positions, and the setpoints of the servos' position
controllers, which move to the goals no faster than the profile velocity."""

_SOON, _STOPS = (1e-4, 1.0), (0.995, 0.995, 0.001, 0.5, 2)
"""Friction stops a joint within two time steps, to which MuJoCo lengthens the time constant. At the default impedance
joints creep as slow motions go; at 0.999 the solver's single precision does not find the force that holds a joint."""


class Servo(Robot):
    """A position-controlled servo: torque = gain * (setpoint - angle), limited to the stall torque.

    The joint's damping is back-EMF and viscous friction together. The driven part is attached to the site ``horn``.
    A gear between servo and joint makes the joint slower and its torque larger; gain, damping and inertia grow by its
    square.
    """

    def _build(self, name: Joint | str, axis: tuple[float, float, float], sheet: DataSheet) -> None:
        gear = self.gear = gear_of(name)
        self.mjcf_model.model = name_of(name)
        horn = self.mjcf_model.worldbody.add("body", name="horn")
        self.joint = horn.add(
            "joint",
            name="joint",
            axis=axis,
            damping=sheet.damping * gear**2,
            armature=sheet.armature * gear**2,
            frictionloss=sheet.friction * gear,
            solreffriction=_SOON,
            solimpfriction=_STOPS,
        )
        self.horn = horn.add("site", name="horn")
        most = (-sheet.stall * gear, sheet.stall * gear)
        self.actuator = self.mjcf_model.actuator.add(
            "position", name="motor", joint=self.joint, kp=sheet.gain * gear**2, forcerange=most, forcelimited=True
        )
        self.profile_rad_s = sheet.profile_rad_s / gear

    @property
    def actuators(self) -> list[Any]:
        """The motor, as a list."""
        return [self.actuator]


class Unobserved(composer.Entity):
    """An entity with disabled observables: each would be computed in every step, and the graph's sensor needs none."""

    def _build_observables(self) -> composer.Observables:
        observables = super()._build_observables()
        observables.disable_all()
        return observables


class ServoDriven(Unobserved, Robot):
    """A robot made of servos, whose setpoints move to their goals with limited speed, as in the firmware.

    Subclasses set ``servos`` when they build their model. The action is one goal per servo, in the same order.

    Attributes:
        servos: The servos.
        low: Lowest goals [rad]; default: half a turn below 0.
        high: Highest goals [rad]; default: half a turn above 0.
    """

    servos: tuple[Servo, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    @property
    def joints(self) -> list[Any]:
        """The joints of the servos."""
        return [s.joint for s in self.servos]

    @property
    def actuators(self) -> list[Any]:
        """The motors of the servos."""
        return [s.actuator for s in self.servos]

    @composer.observable
    def joint_positions(self, physics: Any) -> PyTree:
        """Return the joints' angles ``(joints,)`` [rad]."""
        return physics.bind(self.joints).qpos

    @composer.observable
    def joint_velocities(self, physics: Any) -> PyTree:
        """Return the joints' speeds ``(joints,)`` [rad/s]."""
        return physics.bind(self.joints).qvel

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Set goals and setpoints to the joints' positions."""
        del random_state
        here = physics.np.array(physics.bind(self.joints).qpos)
        physics.variables[GOAL], physics.variables[REFERENCE] = here, here

    def before_substep(self, physics: Any, random_state: Any) -> None:
        """Move the setpoints towards the goals by one time step."""
        del random_state
        most = np.array([s.profile_rad_s for s in self.servos]) * physics.timestep()
        before = physics.variables[REFERENCE]
        move = physics.np.clip(physics.variables[GOAL] - before, -most, most)
        physics.variables[REFERENCE] = before + move
        # The control is the setpoint's mean over the step. Compared with steps a fifth as long, the arm of
        # pipelines/arm is then off by 0.4 to 1.2 mrad; with the setpoint at the step's end it is half a step early, 2
        # to 4 mrad.
        physics.set_control(before + move * (1.0 - 0.5 * physics.np.abs(move) / most))


class GoalTask(Task):
    """A task for a ``ServoDriven`` robot, which has all actuators of its world: the action is its goals [rad]."""

    robot: ServoDriven

    @property
    def joints(self) -> list[Any]:
        """The joints of the robot's servos."""
        return self.robot.joints

    def action_spec(self, physics: Any) -> specs.BoundedArray:
        """Return shape ``(joints,)`` and bounds of the goals [rad]; its name lists the joints, separated by tabs."""
        del physics
        count = len(self.robot.servos)
        names = "\t".join(servo.mjcf_model.model for servo in self.robot.servos)
        low, high = self.robot.low or (-math.pi,) * count, self.robot.high or (math.pi,) * count
        return specs.BoundedArray((count,), float, low, high, name=names)

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
        """Set the goals.

        Args:
            action: Shape ``(joints,)``: goals [rad].
        """
        del random_state
        physics.variables[GOAL] = physics.np.asarray(action)


def rubs_only(model: mjcf.RootElement) -> None:
    """Make the steps of an arena's model fast, for joints that rub and links that touch nothing."""
    model.option.integrator = "implicitfast"
    # After two seconds one step of Newton's method is 0.8 mrad off a hundred of them, at a seventh of the time of
    # training. Only joints that friction should hold shiver, by 0.05 rad/s, and creep: a deployment takes more.
    model.option.iterations, model.option.ls_iterations = 1, 4
    # Frames and links that do not move against each other become one body: of an arm of three joints 4 instead of 14,
    # and 5 times the speed.
    model.compiler.fusestatic = True
    model.compiler.boundmass = model.compiler.boundinertia = 0  # frames between the parts weigh nothing
    model.option.flag.contact = "disable"  # the goals' limits keep a robot off the floor
