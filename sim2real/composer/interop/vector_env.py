"""A composed task as a gymnasium vector environment: many copies, stepped together on MJX."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from dm_env import specs

from sim2real.composer.mjx.environment import MjxEnvironment
from sim2real.composer.task import UNLIMITED
from sim2real.errors import Sim2RealError, UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError as error:
    raise Sim2RealError(
        "MjxVectorEnv needs gymnasium, which is not installed", hint="pip install 'sim2real[interop]'"
    ) from error


class MjxVectorEnv(VectorEnv):
    """Copies of a task, with the interface of ``gymnasium.vector``; a copy that is done starts anew at the next step.

    Args:
        environment: The task as a pure environment.
        num_envs: Number of copies.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012 - gymnasium's own form

    def __init__(self, environment: MjxEnvironment, num_envs: int) -> None:
        self.environment, self.num_envs = environment, num_envs
        self.single_action_space = _action_box(environment.action_spec())
        self.single_observation_space = gymnasium.spaces.Dict(
            {k: _box(v) for k, v in environment.observation_spec().items()}
        )
        batch = gymnasium.vector.utils.batch_space
        self.action_space = batch(self.single_action_space, num_envs)
        self.observation_space = batch(self.single_observation_space, num_envs)
        self._reset = jax.jit(jax.vmap(environment.reset))
        self._step = jax.jit(jax.vmap(environment.step))
        self._select = jax.jit(jax.vmap(environment.select))
        self._key = jax.random.key(0)
        self._state: Any = None
        self._done = np.zeros(num_envs, bool)

    def _keys(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return jax.random.split(key, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start all copies; return observations and infos."""
        del options
        if seed is not None:
            self._key = jax.random.key(seed)
        self._state = self._reset(self._keys())
        self._done = np.zeros(self.num_envs, bool)
        return self._observation(), {"failed": np.asarray(self._state.failed)}

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all copies; return observations, rewards, terminations, truncations and infos."""
        before, done = self._state, self._done
        self._state = self._step(before, np.asarray(actions))
        if done.any():
            self._state = self._select(done, self._reset(self._keys()), self._state)
        state = self._state
        truncated = np.asarray(state.truncated)
        self._done = np.asarray(state.done)
        infos = {"discount": np.asarray(state.discount), "failed": np.asarray(state.failed)}
        return self._observation(), np.asarray(state.reward), self._done & ~truncated, truncated, infos

    def _observation(self) -> dict[str, np.ndarray]:
        return {k: np.asarray(v) for k, v in self._state.observation.items()}


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
