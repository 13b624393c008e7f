"""Copies of a composed task or of a robot, with the interface of ``gymnasium.vector``.

Two compiled programs step all copies together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from dm_env import specs

from sim2real.composer.mjx_environment import MjxEnvironment, State
from sim2real.composer.task import UNLIMITED
from sim2real.errors import Sim2RealError, UsageError
from sim2real.installation import with_extra
from sim2real.interop.robot import Copy, RobotEnvironment, specs_of
from sim2real.training.environment.protocol import select

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError as error:
    raise Sim2RealError(
        "environments for gymnasium need gymnasium, which is not installed", hint=with_extra("interop")
    ) from error

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike
    from sim2real.types import Array, PyTree

_SEEDS = 2**32
Infos = dict[str, "PyTree"]
"""Name -> values of the copies, and ``_NAME`` -> mask of the copies that have one."""


class Shown(NamedTuple):
    """What a step shows of a copy."""

    observation: PyTree
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    infos: dict[str, jax.Array]
    values: dict[str, jax.Array]


def shown(state: State | Copy) -> Shown:
    """Return what a step shows of a copy: of a task its discount too, of a robot values of the whole episode."""
    of_task = isinstance(state, State)
    infos = {"discount": state.discount, "failed": state.failed} if of_task else {}
    terminated, values = state.done & ~state.truncated, {} if of_task else state.values
    return Shown(state.observation, state.reward, terminated, state.truncated, infos, values)


class CopiesVectorEnv(VectorEnv):
    """Copies of a composed task, whose observations are dictionaries of observables, or of a robot with its delays.

    With ``AutoresetMode.NEXT_STEP`` a copy that is done is reset at the next step, whose action is ignored and whose
    reward is 0. With ``SAME_STEP`` it is reset at once; ``infos`` then has ``final_obs`` and ``final_info``. With
    ``DISABLED`` the caller resets it: ``reset(options={"reset_mask": mask})``.

    Copy i of ``reset(seed=s)`` has the seed s + i, as in gymnasium's own vector environments. The episodes of a copy
    depend on its seed and its actions alone. At the end of an episode of a robot infos have its ``return`` and
    ``success``: the share of its second half in which the task was fulfilled.

    Attributes:
        environment: One copy; of a robot, ``environment.observation`` and ``.action`` name each entry.

    Raises:
        UsageError: When ``num_envs`` is below 1, or there is no such mode.
    """

    def __init__(
        self,
        environment: MjxEnvironment | RobotEnvironment,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        if num_envs < 1:
            raise UsageError(f"num_envs must be at least 1, got {num_envs}")
        modes = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in (*AutoresetMode, *modes):
            raise UsageError(f"unknown autoreset_mode {autoreset_mode!r}. Available: {', '.join(modes)}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.num_envs = num_envs
        # Spaces of one copy, and of all copies.
        observation, action = specs_of(environment)
        if isinstance(observation, dict):
            self.single_observation_space = gymnasium.spaces.Dict({k: _box(v) for k, v in observation.items()})
        else:
            self.single_observation_space = _box(observation)
        self.single_action_space = _action_box(action)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        # Compiled functions over all copies.
        self.environment = environment
        step: PyTree = environment.step
        self._step = jax.jit(jax.vmap(lambda state, action: step(state, action)))
        self._start, self._restart = jax.jit(self._reset_all), jax.jit(self._reset_some)
        self._keys_of = jax.jit(jax.vmap(jax.random.key))
        self._keys: jax.Array | None = None
        self._last: PyTree = None
        self._done = np.zeros(num_envs, bool)

    def _reset_all(self, keys: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return all copies at the start of an episode, and their keys for the next one."""
        next_keys, keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        return jax.vmap(lambda key: self.environment.reset(key))(keys), next_keys

    def _reset_some(self, last: PyTree, keys: jax.Array, mask: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the copies, those of the mask at the start of an episode, and the keys for the next ones."""
        fresh, next_keys = self._reset_all(keys)
        return select(mask, fresh, last), select(mask, next_keys, keys)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Array] | None = None
    ) -> tuple[PyTree, Infos]:
        """Start all copies, or those of ``options["reset_mask"]``; return observations and infos.

        Raises:
            UsageError: When a seed or the mask is of the wrong kind or shape.
        """
        super().reset(seed=seed if isinstance(seed, int | np.integer) else None)
        mask = self._mask(options)
        # New keys for the reset copies.
        if seed is not None or self._keys is None:
            keys = self._keys_of(self._seeds(seed))
            is_partial = self._keys is not None and mask is not None
            self._keys = select(jax.numpy.asarray(mask), keys, self._keys) if is_partial else keys
        # Reset all copies, or those of the mask.
        if mask is None or self._last is None:
            last, self._keys = self._start(self._keys)
            self._done = np.zeros(self.num_envs, bool)
        else:
            last, self._keys = self._restart(self._last, self._keys, jax.numpy.asarray(mask))
            self._done = self._done & ~mask
        self._last = last
        first = jax.device_get(shown(last))
        return _writable(first.observation), _masked(first.infos, np.ones(self.num_envs, bool))

    def step(self, actions: ArrayLike) -> tuple[PyTree, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Step all copies; return observations, rewards, terminations, truncations and infos.

        Raises:
            UsageError: Before ``reset``, when the actions have the wrong shape or are not finite, or when the caller
                has to reset a copy first.
        """
        if self._last is None:
            raise UsageError("step() was called before reset()", hint="call reset() first")
        mode, done_before = self.autoreset_mode, self._done
        if mode is AutoresetMode.DISABLED and done_before.any():
            raise UsageError(
                f"copies {np.flatnonzero(done_before).tolist()} are done",
                hint="reset them: reset(options={'reset_mask': terminations | truncations})",
            )
        last = self._step(self._last, self._checked(actions))
        # Reset the copies that were done before this step.
        if mode is AutoresetMode.NEXT_STEP and done_before.any():
            last, self._keys = self._restart(last, self._keys, done_before)
        # Copy the results to the host at once; the state stays on the device.
        results = jax.device_get(shown(last))
        done = results.terminated | results.truncated
        episode_values = _masked(results.values, done) if done.any() else {}
        all_copies = np.ones(self.num_envs, bool)
        observation, infos = results.observation, _masked(results.infos, all_copies) | episode_values
        self._done = done
        # Reset the copies that are done now, and keep their last observation.
        if mode is AutoresetMode.SAME_STEP and done.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final[i] = jax.tree.map(lambda leaf, i=i: np.array(leaf[i]), observation)
            final_info = _masked(results.infos, done) | episode_values
            last, self._keys = self._restart(last, self._keys, done)
            first = jax.device_get(shown(last))
            observation, infos = first.observation, _masked(first.infos, all_copies)
            infos |= {"final_obs": final, "_final_obs": done, "final_info": final_info, "_final_info": done}
            self._done = np.zeros(self.num_envs, bool)
        self._last = last
        reward = np.array(results.reward, np.float64)
        return _writable(observation), reward, np.array(results.terminated), np.array(results.truncated), infos

    def _checked(self, actions: ArrayLike) -> np.ndarray:
        array, space = np.asarray(actions), self.action_space
        if array.shape != space.shape:
            raise UsageError(
                f"actions have shape {array.shape}, {self.num_envs} copies need {space.shape}",
                hint="one row for each copy, also where there is one copy or one action",
            )
        if not np.issubdtype(array.dtype, np.number) or np.issubdtype(array.dtype, np.complexfloating):
            raise UsageError(f"actions must be real numbers, got {array.dtype}")
        if not np.isfinite(array).all():
            rows = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))).tolist()
            raise UsageError(f"actions of copies {rows} are not finite", hint="the policy has diverged")
        return array.astype(space.dtype)

    def _seeds(self, seed: int | Sequence[int | None] | None) -> np.ndarray:
        """Return a seed for each copy."""
        seeds = self.np_random.integers(_SEEDS, size=self.num_envs)
        if isinstance(seed, int | np.integer):
            seeds = int(seed) + np.arange(self.num_envs)
        elif seed is not None:
            if len(seed) != self.num_envs:
                raise UsageError(f"{len(seed)} seeds were given for {self.num_envs} copies")
            seeds = np.array([r if s is None else int(s) for s, r in zip(seed, seeds, strict=True)])
        return (seeds % _SEEDS).astype(np.uint32)

    def _mask(self, options: dict[str, Array] | None) -> np.ndarray | None:
        """Return the copies to reset; None: all."""
        if not options or "reset_mask" not in options:
            return None
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise UsageError(
                f"reset_mask must be bool of shape ({self.num_envs},) with a copy to reset, "
                f"got {mask.dtype} of shape {mask.shape}"
            )
        return mask


def _box(spec: specs.Array) -> gymnasium.spaces.Box:
    """Return the space of arrays of a spec; a type without bounds has those of its dtype."""
    if spec.dtype == bool:
        return gymnasium.spaces.Box(0, 1, spec.shape, np.int8)
    if isinstance(spec, specs.BoundedArray):
        low, high = (np.broadcast_to(b, spec.shape) for b in (spec.minimum, spec.maximum))
        return gymnasium.spaces.Box(low, high, dtype=spec.dtype.type)
    if np.issubdtype(spec.dtype, np.floating):
        return gymnasium.spaces.Box(-np.inf, np.inf, spec.shape, spec.dtype.type)
    info = np.iinfo(spec.dtype)
    return gymnasium.spaces.Box(info.min, info.max, spec.shape, spec.dtype.type)


def _action_box(spec: specs.Array) -> gymnasium.spaces.Box:
    """Return the space of actions, in single precision; a bound of 1e10 is dm_env's way to write that there is none."""
    if not np.issubdtype(spec.dtype, np.floating):
        return _box(spec)
    bounds = (getattr(spec, "minimum", -np.inf), getattr(spec, "maximum", np.inf))
    low, high = (np.broadcast_to(b, spec.shape).astype(float) for b in bounds)
    low, high = np.where(low <= -UNLIMITED, -np.inf, low), np.where(high >= UNLIMITED, np.inf, high)
    return gymnasium.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def _writable(observation: PyTree) -> PyTree:
    """Return a copy: the arrays of JAX are read-only."""
    return jax.tree.map(np.array, observation)


def _masked(values: dict[str, Array], mask: np.ndarray) -> Infos:
    """Return infos in gymnasium's form: each with a mask of the copies that have one."""
    return {key: v for name, value in values.items() for key, v in ((name, np.array(value)), (f"_{name}", mask.copy()))}
