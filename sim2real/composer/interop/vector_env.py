"""A composed task as a gymnasium vector environment: many copies, stepped together on MJX."""

from __future__ import annotations

import jax
import numpy as np
from dm_env import specs

from sim2real.composer.interop.copies import AutoresetMode, CopiesVectorEnv, gymnasium
from sim2real.composer.interop.task import PureTask, check_shown
from sim2real.composer.physics.mjx.environment import MjxEnvironment
from sim2real.composer.task import UNLIMITED
from sim2real.errors import UsageError


class MjxVectorEnv(CopiesVectorEnv):
    """Copies of a task, with the interface of ``gymnasium.vector``; observations are dictionaries of observables.

    Args:
        autoreset_mode: What happens to a copy that is done; see ``CopiesVectorEnv``.

    Raises:
        UsageError: When the task shows its policy nothing, or its action is not one array.
    """

    def __init__(
        self,
        environment: MjxEnvironment,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.environment = environment
        action = _action_box(environment.action_spec())
        observation = gymnasium.spaces.Dict({k: _box(v) for k, v in check_shown(environment).items()})
        super().__init__(PureTask(environment, flat=False), num_envs, observation, action, autoreset_mode)


def _action_box(spec: object) -> gymnasium.spaces.Box:
    """Return the space of actions; what dm_env writes as a bound of 1e10 has none."""
    if not isinstance(spec, specs.Array):
        raise UsageError(
            f"MjxVectorEnv takes actions that are one array, and the task's action_spec is {spec!r}",
            hint="override action_spec in the task",
        )
    dtype = np.float32 if np.issubdtype(spec.dtype, np.floating) else spec.dtype
    bounds = (getattr(spec, "minimum", -np.inf), getattr(spec, "maximum", np.inf))
    low, high = (np.broadcast_to(b, spec.shape).astype(float) for b in bounds)
    low, high = np.where(low <= -UNLIMITED, -np.inf, low), np.where(high >= UNLIMITED, np.inf, high)
    return gymnasium.spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


def _box(leaf: jax.ShapeDtypeStruct) -> gymnasium.spaces.Box:
    if np.issubdtype(leaf.dtype, np.floating):
        return gymnasium.spaces.Box(-np.inf, np.inf, leaf.shape, leaf.dtype)
    if leaf.dtype == bool:
        return gymnasium.spaces.Box(0, 1, leaf.shape, np.int8)
    info = np.iinfo(leaf.dtype)
    return gymnasium.spaces.Box(info.min, info.max, leaf.shape, leaf.dtype)
