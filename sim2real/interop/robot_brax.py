"""A robot with its delays as a brax environment."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.interop.counted import PureBraxEnv
from sim2real.composer.interop.moment import Moment
from sim2real.interop.environment import RobotEnvironment


class RobotBraxEnv(PureBraxEnv):
    """One robot with its delays, with the interface of ``brax.envs``; see ``PureBraxEnv`` for episodes and their ends.

    brax knows no bounds of actions; its learners send values between -1 and 1. So here an action of -1 stands for the
    lower bound of ``robot.action`` and 1 for the upper one.

    ``metrics`` has an episode's ``return`` and ``success`` in the step that ends it, and 0 in all others: the sums that
    brax makes over an episode are its values.

    Args:
        fresh_starts: Whether each episode of a copy starts from a state of its own, at the price of a reset a step.

    Attributes:
        robot: One copy; ``robot.observation`` and ``robot.action`` name each entry, with unit and bounds.
    """

    def __init__(self, robot: RobotEnvironment, fresh_starts: bool = True) -> None:
        self.robot = robot
        sizes = len(robot.observation), len(robot.action)
        super().__init__(_Scaled(robot), sizes, 1.0 / robot.rate_hz, robot.length, fresh_starts)


class _Scaled:
    """A robot whose actions lie between -1 and 1."""

    def __init__(self, robot: RobotEnvironment) -> None:
        self._robot = robot
        low, high = np.array([(e.low, e.high) for e in robot.action], np.float32).T
        self._middle, self._half = (high + low) / 2, (high - low) / 2
        self.reset, self.cut, self.reseed = robot.reset, robot.cut, robot.reseed

    def step(self, state: Any, action: jax.Array) -> Moment:
        return self._robot.step(state, self._middle + self._half * jnp.clip(action, -1.0, 1.0))
