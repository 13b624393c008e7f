"""The class of robots of servos of the last release, kept for one release."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import namespace
from sim2real.identify.parameters import Parameter
from sim2real.robots.contract import Robot
from sim2real.robots.control_loop.hardware import Embedded
from sim2real.robots.control_loop.messages import JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.servo import parameters
from sim2real.robots.servo.drive import JointSensor, ServoDrive
from sim2real.robots.servo.model import ComposedModel
from sim2real.robots.servo.observation import Feature, ServoAgent
from sim2real.robots.servo.parts import GoalTask
from sim2real.robots.servo.payload import Hand
from sim2real.robots.servo.servos import Servos as Servos
from sim2real.robots.servo.task import Aim, AimTask
from sim2real.train.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree


class ServoRobot(Robot):
    """A robot whose parts are made from the attributes and methods of a subclass.

    Write a ``Robot`` with five parts instead, as docs/tutorial.md does: this class goes with the next release.
    """

    servos: Servos
    aim: tuple[tuple[str, str], ...] = ()
    features: tuple[Feature, ...] | None = None
    history: int = 3
    hand: Hand | None = None
    probe: Probe | None = None
    embedded: Embedded | None = None
    position_sigma_rad: float = 0.002
    velocity_sigma_rad_s: float = 0.05

    def __init_subclass__(cls, **options: object) -> None:
        """Warn of the next release."""
        super().__init_subclass__(**options)
        warnings.warn(
            f"{cls.__name__} inherits from ServoRobot, which goes with the next release: write a "
            "sim2real.robots.contract.Robot with five parts, as in docs/tutorial.md",
            FutureWarning,
            stacklevel=2,
        )

    def __init__(self) -> None:
        declared: Any = type(self).causes
        causes = {} if isinstance(declared, property) else declared
        servos, aim = self.servos, Aim(self.aim, self.draw_aim, self.aim_fields, self.place_aim)
        self.sensor = JointSensor(servos, self.position_sigma_rad, self.velocity_sigma_rad_s)
        self.drive = ServoDrive(servos, probe=self.probe, embedded=lambda: self.embedded)
        self.agent = ServoAgent(servos, aim, self.features, self.observe, self.history, self.roles)
        self.model = ComposedModel(servos, self.make_task, aim, self.hand, self.dynamics, causes, self.roles)
        self.task = AimTask(servos, aim, self.success, self.score, self.reward)

    def make_task(self) -> GoalTask:
        """Return a new task."""
        raise NotImplementedError

    def draw_aim(self, key: Key) -> Array:
        """Return the aim of an episode, ``(k,)``."""
        raise NotImplementedError

    def success(self, state: PyTree) -> jax.Array:
        """Return whether the task is fulfilled, bool."""
        raise NotImplementedError

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return figures of how well a deployment went."""
        raise NotImplementedError

    def aim_fields(self, task: GoalTask) -> Mapping[str, tuple[PyTree, str]]:
        """Return the parts of the model that an aim sets: name -> (elements, attribute)."""
        del task
        return {}

    def place_aim(self, aim: Array) -> dict[str, PyTree]:
        """Return the arrays of ``aim_fields`` for an aim ``(k,)``."""
        del aim
        return {}

    def dynamics(self) -> list[Parameter]:
        """Return the parameters that may be identified, at their data sheet's values."""
        of_servos = parameters.parameters(self.servos.sheet, self.servos.joints)
        return [*of_servos, self.hand.parameter()] if self.hand else of_servos

    def reward(self, state: PyTree, action: jax.Array) -> Rewards:
        """Return the reward of a policy step: the task's, minus a small penalty on the speed of the goals."""
        return {"task": state.reward, "speed": -0.01 * jnp.mean((action / self.servos.speed) ** 2)}

    def observe(self, reading: JointReading, goal: Array, aim: Array) -> Array:
        """Return the present part of the observation."""
        return namespace(goal).concatenate([reading.position, reading.velocity, goal, aim])

    def twin(self, emulator: Any, **factors: float) -> Embedded:
        """Return an emulated robot with this robot's model."""
        model: Any = self.model
        return model.twin(emulator, **factors)
