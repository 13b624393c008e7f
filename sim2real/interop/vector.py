"""Copies of a composed task or of a robot, with the interface of ``gymnasium.vector``.

Two compiled programs step and reset all copies together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from sim2real.composer.task import UNLIMITED
from sim2real.errors import Sim2RealError, UsageError
from sim2real.installation import with_extra
from sim2real.interop.robot import RobotEnvironment, specs_of
from sim2real.training.environment.protocol import select

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError as error:
    raise Sim2RealError(
        "environments for gymnasium need gymnasium, which is not installed", hint=with_extra("interop")
    ) from error

if TYPE_CHECKING:
    import numpy.typing as npt

    from sim2real.composer.mjx_environment import MjxEnvironment
    from sim2real.composer.types import ArrayLike
    from sim2real.types import Array, PyTree

_SEEDS = 2**32
_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
Infos = dict[str, "PyTree"]
"""Name -> values of the copies, and ``_NAME`` -> mask of the copies that have a value."""


class CopiesVectorEnv(VectorEnv):
    """Copies of a composed task, whose observations are dictionaries of observables, or of a robot with its delays.

    With ``AutoresetMode.NEXT_STEP`` a finished copy is reset at the next step, whose action is ignored and whose reward
    is 0. With ``SAME_STEP`` it is reset at once; ``infos`` then has ``final_obs`` and ``final_info``.

    Copy i of ``reset(seed=s)`` has the seed s + i, as in gymnasium's vector environments. The episodes of a copy depend
    only on its seed and its actions. At the end of an episode of a robot, infos have its ``return`` and ``success``:
    the share of the second half of the episode in which the task was fulfilled.

    Attributes:
        environment: One copy; of a robot, ``environment.observation`` and ``.action`` name each entry.

    Raises:
        UsageError: ``num_envs`` is below 1, or there is no such mode.
    """

    def __init__(
        self,
        environment: MjxEnvironment | RobotEnvironment,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        if num_envs < 1:
            raise UsageError(f"num_envs must be at least 1, got {num_envs}")
        names = [mode.value for mode in _MODES]
        if autoreset_mode not in (*_MODES, *names):
            raise UsageError(f"unknown autoreset_mode {autoreset_mode!r}. Available: {', '.join(names)}")
        self.environment, self.num_envs, self.autoreset_mode = environment, num_envs, AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        # Spaces of one copy, and of all copies.
        observation, action = specs_of(environment)
        if isinstance(observation, Mapping):
            self.single_observation_space = gymnasium.spaces.Dict({k: _box(v, v.dtype) for k, v in observation.items()})
        else:
            self.single_observation_space = _box(observation, observation.dtype)
        is_float = np.issubdtype(action.dtype, np.floating)
        self.single_action_space = _box(action, np.float32 if is_float else action.dtype)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        # Compiled functions over all copies.
        step: PyTree = environment.step
        self._step = jax.jit(jax.vmap(lambda state, action: step(state, action)))
        self._start, self._restart = jax.jit(self._reset_all), jax.jit(self._reset_some)
        self._keys: jax.Array | None = None
        self._last: PyTree = None
        self._done = np.zeros(num_envs, bool)

    def _reset_all(self, keys: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return all copies at the start of an episode, and their keys for the next one."""
        next_keys, keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        return jax.vmap(lambda key: self.environment.reset(key))(keys), next_keys

    def _reset_some(self, last: PyTree, keys: jax.Array, mask: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the copies, with those of the mask at the start of an episode, and the keys for the next episodes."""
        fresh, next_keys = self._reset_all(keys)
        return select(mask, fresh, last), select(mask, next_keys, keys)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, PyTree] | None = None
    ) -> tuple[PyTree, Infos]:
        """Start all copies; return observations and infos.

        Raises:
            UsageError: The number of seeds is wrong, or options are given, of which there are none.
        """
        super().reset(seed=seed if isinstance(seed, int | np.integer) else None)
        if options:
            raise UsageError(f"reset takes no options, got {', '.join(options)}")
        if seed is not None or self._keys is None:
            self._keys = jax.vmap(jax.random.key)(self._seeds(seed))
        self._last, self._keys = self._start(self._keys)
        self._done = np.zeros(self.num_envs, bool)
        observation, *_, infos, _ = jax.device_get(_shown(self._last))
        return _writable(observation), _masked(infos, np.ones(self.num_envs, bool))

    def step(self, actions: ArrayLike) -> tuple[PyTree, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Step all copies; return observations, rewards, terminations, truncations and infos.

        Raises:
            UsageError: ``reset`` was not called, or the actions have the wrong shape or are not finite.
        """
        if self._last is None:
            raise UsageError("step() was called before reset()", hint="call reset() first")
        last = self._step(self._last, self._checked(actions))
        if self._done.any():  # copies that finished in the step before, in the mode NEXT_STEP
            last, self._keys = self._restart(last, self._keys, self._done)
        # Copy the results to the host at once; the state stays on the device.
        observation, reward, terminated, truncated, infos, values = jax.device_get(_shown(last))
        done = terminated | truncated
        everyone = np.ones(self.num_envs, bool)
        of_episode = _masked(values, done) if done.any() else {}
        told = _masked(infos, everyone) | of_episode
        # Reset the copies that have just finished, and keep their last observation.
        if self.autoreset_mode is AutoresetMode.SAME_STEP and done.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final[i] = jax.tree.map(lambda leaf, i=i: np.array(leaf[i]), observation)
            final_info = _masked(infos, done) | of_episode
            last, self._keys = self._restart(last, self._keys, done)
            observation, *_, infos, _ = jax.device_get(_shown(last))
            told = _masked(infos, everyone)
            told |= {"final_obs": final, "_final_obs": done, "final_info": final_info, "_final_info": done}
        self._last = last
        self._done = done & (self.autoreset_mode is AutoresetMode.NEXT_STEP)
        return _writable(observation), np.array(reward, np.float64), np.array(terminated), np.array(truncated), told

    def _checked(self, actions: ArrayLike) -> np.ndarray:
        array, space = np.asarray(actions), self.action_space
        if array.shape != space.shape:
            raise UsageError(
                f"actions have shape {array.shape}, {self.num_envs} copies need {space.shape}",
                hint="one row for each copy, even for one copy or one action",
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


def _shown(state: PyTree) -> tuple[PyTree, ...]:
    """Return observation, reward, terminated, truncated, infos and values of the whole episode of a state.

    The state of a task has infos, that of a robot has values.
    """
    infos = {name: getattr(state, name) for name in ("discount", "failed") if hasattr(state, name)}
    flags = state.done & ~state.truncated, state.truncated
    return state.observation, state.reward, *flags, infos, getattr(state, "values", {})


def _box(spec: PyTree, dtype: npt.DTypeLike) -> gymnasium.spaces.Box:
    """Return the space of a spec; without bounds, the space has the range of the dtype."""
    dtype = np.dtype(dtype)
    if dtype.kind == "b":
        return gymnasium.spaces.Box(0, 1, spec.shape, np.int8)
    is_float = np.issubdtype(dtype, np.floating)
    widest = (-np.inf, np.inf) if is_float else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    low, high = (
        np.broadcast_to(getattr(spec, name, bound), spec.shape)
        for name, bound in zip(("minimum", "maximum"), widest, strict=True)
    )
    if is_float:  # in dm_control, a bound of 1e10 means no bound
        low, high = np.where(low <= -UNLIMITED, -np.inf, low), np.where(high >= UNLIMITED, np.inf, high)
    return gymnasium.spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype.type)


def _writable(observation: PyTree) -> PyTree:
    """Return a copy: the arrays of JAX are read-only."""
    return jax.tree.map(np.array, observation)


def _masked(values: dict[str, Array], mask: np.ndarray) -> Infos:
    """Return infos in gymnasium's form: each with a mask of the copies that have one."""
    return {key: v for name, value in values.items() for key, v in ((name, np.array(value)), (f"_{name}", mask.copy()))}
