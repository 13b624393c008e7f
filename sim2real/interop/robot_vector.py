"""A robot with its delays as a gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.composer.interop.copies import AutoresetMode, CopiesVectorEnv, gymnasium
from sim2real.interop.entries import Entry
from sim2real.interop.environment import RobotEnvironment


class RobotVectorEnv(CopiesVectorEnv):
    """Copies of a robot with its delays; see ``CopiesVectorEnv`` for seeds, resets and ends of episodes.

    Where an episode ends, infos have its ``return`` and ``success``: the share of its second half in which the task was
    fulfilled.

    Args:
        autoreset_mode: What happens to a copy that is done.

    Attributes:
        robot: One copy; ``robot.observation`` and ``robot.action`` name each entry, with unit and bounds.
    """

    def __init__(
        self,
        robot: RobotEnvironment,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.robot = robot
        super().__init__(robot, num_envs, _box(robot.observation), _box(robot.action), autoreset_mode)


def _box(entries: Sequence[Entry]) -> gymnasium.spaces.Box:
    low, high = np.array([(e.low, e.high) for e in entries], np.float32).T
    return gymnasium.spaces.Box(low, high, dtype=np.float32)
