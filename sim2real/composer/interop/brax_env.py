"""A composed task as a brax environment."""

from __future__ import annotations

import math

from sim2real.composer.interop.counted import PureBraxEnv
from sim2real.composer.interop.task import PureTask, check_shown
from sim2real.composer.physics.mjx.environment import MjxEnvironment


class BraxEnv(PureBraxEnv):
    """Runs a task on MJX with the interface of ``brax.envs``; see ``PureBraxEnv`` for episodes and their ends.

    The observation is a vector: the task's observables, one after the other, in their order. Actions are what the
    task's ``action_spec`` says. ``info["failed"]`` is 1 where no initial state was found.

    Args:
        fresh_starts: Whether each episode of a copy starts from a state of its own, at the price of a reset a step.

    Raises:
        UsageError: When the task shows its policy nothing.
    """

    def __init__(self, environment: MjxEnvironment, fresh_starts: bool = True) -> None:
        self.environment = environment
        size = sum(leaf.size for leaf in check_shown(environment).values())
        sizes = (size, math.prod(environment.action_spec().shape))
        dt_s = environment.task.control_timestep
        super().__init__(PureTask(environment, flat=True), sizes, dt_s, environment.step_limit, fresh_starts)
