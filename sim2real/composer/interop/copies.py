"""Copies of a pure environment with the interface of ``gymnasium.vector``: two compiled programs step them together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from sim2real.composer.interop.moment import Moment, PureEnvironment, choose
from sim2real.errors import Sim2RealError, UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError as error:
    raise Sim2RealError(
        "environments for gymnasium need gymnasium, which is not installed", hint="pip install 'sim2real[interop]'"
    ) from error

_SEEDS = 2**32


class CopiesVectorEnv(VectorEnv):
    """Copies of a pure environment.

    With ``AutoresetMode.NEXT_STEP`` a copy that is done starts anew at the next step, whose action is ignored and whose
    reward is 0. With ``SAME_STEP`` it starts anew at once; ``infos`` then has ``final_obs`` and ``final_info``. With
    ``DISABLED`` the caller resets it: ``reset(options={"reset_mask": mask})``.

    Copy i of ``reset(seed=s)`` has the seed s + i, as gymnasium's own vector environments have it. The episodes of a
    copy depend on its seed and its actions, and on no other copy.

    Args:
        autoreset_mode: What happens to a copy that is done, ``AutoresetMode`` or its value, e.g. ``"SameStep"``.

    Raises:
        UsageError: Without a copy, or in an unknown mode.
    """

    def __init__(
        self,
        pure: PureEnvironment,
        num_envs: int,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
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
        self.single_observation_space, self.single_action_space = observation_space, action_space
        batch = gymnasium.vector.utils.batch_space
        self.observation_space, self.action_space = batch(observation_space, num_envs), batch(action_space, num_envs)
        self._pure = pure
        self._step = jax.jit(jax.vmap(pure.step))
        self._start, self._restart = jax.jit(self._started), jax.jit(self._restarted)
        self._seeded = jax.jit(jax.vmap(jax.random.key))
        self._keys: Any = None
        self._moment: Moment | None = None
        self._done = np.zeros(num_envs, bool)

    def _started(self, keys: jax.Array) -> tuple[Moment, jax.Array]:
        """Return all copies at the start of an episode, and their keys for the next one."""
        following, own = jax.vmap(jax.random.split, out_axes=1)(keys)
        return jax.vmap(self._pure.reset)(own), following

    def _restarted(self, moment: Moment, keys: jax.Array, mask: jax.Array) -> tuple[Moment, jax.Array]:
        """Return the copies, those of the mask at the start of an episode, and the keys for the next ones."""
        fresh, following = self._started(keys)
        return choose(mask, fresh, moment), choose(mask, following, keys)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start all copies, or those of ``options["reset_mask"]``; return observations and infos.

        Raises:
            UsageError: When a seed or the mask is of the wrong kind or shape.
        """
        super().reset(seed=seed if isinstance(seed, int | np.integer) else None)
        chosen = self._mask(options)
        mask = None if chosen is None else jax.numpy.asarray(chosen)
        if seed is not None or self._keys is None:
            keys = self._seeded(self._seeds(seed))
            self._keys = keys if self._keys is None or mask is None else choose(mask, keys, self._keys)
        if chosen is None or self._moment is None:
            moment, self._keys = self._start(self._keys)
            self._done = np.zeros(self.num_envs, bool)
        else:
            moment, self._keys = self._restart(self._moment, self._keys, mask)
            self._done = self._done & ~chosen
        self._moment = moment
        observation, info = jax.device_get((moment.observation, moment.info))
        return _own(observation), _masked(info, np.ones(self.num_envs, bool))

    def step(self, actions: ArrayLike) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all copies; return observations, rewards, terminations, truncations and infos.

        Raises:
            UsageError: Before ``reset``, when the actions have the wrong shape or are not finite, or when a copy is
                done that the caller resets.
        """
        if self._moment is None:
            raise UsageError("step() was called before reset()", hint="call reset() first")
        mode, before = self.autoreset_mode, self._done
        if mode is AutoresetMode.DISABLED and before.any():
            raise UsageError(
                f"copies {np.flatnonzero(before).tolist()} are done",
                hint="reset them: reset(options={'reset_mask': terminations | truncations})",
            )
        moment = self._step(self._moment.state, self._checked(actions))
        if mode is AutoresetMode.NEXT_STEP and before.any():
            moment, self._keys = self._restart(moment, self._keys, before)
        seen = moment._replace(state=None)
        observation, reward, terminated, truncated, info, ending = jax.device_get(seen)[1:]
        done = terminated | truncated
        everywhere = np.ones(self.num_envs, bool)
        last = _masked(ending, done) if done.any() else {}
        infos = _masked(info, everywhere) | last
        if mode is AutoresetMode.SAME_STEP and done.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(done):
                final[i] = jax.tree.map(lambda leaf, i=i: np.array(leaf[i]), observation)
            before_reset = _masked(info, done) | last
            moment, self._keys = self._restart(moment, self._keys, done)
            observation, info = jax.device_get((moment.observation, moment.info))
            infos = _masked(info, everywhere)
            infos |= {"final_obs": final, "_final_obs": done, "final_info": before_reset, "_final_info": done}
            self._done = np.zeros(self.num_envs, bool)
        else:
            self._done = done
        self._moment = moment
        return _own(observation), np.array(reward, np.float64), np.array(terminated), np.array(truncated), infos

    def _checked(self, actions: ArrayLike) -> np.ndarray:
        given = np.asarray(actions)
        space = self.action_space
        if given.shape != space.shape:
            raise UsageError(
                f"actions have shape {given.shape}, {self.num_envs} copies need {space.shape}",
                hint="one row for each copy, also where there is one copy or one action",
            )
        if not np.issubdtype(given.dtype, np.number) or np.issubdtype(given.dtype, np.complexfloating):
            raise UsageError(f"actions must be real numbers, got {given.dtype}")
        if not np.isfinite(given).all():
            rows = np.flatnonzero(~np.isfinite(given).all(axis=tuple(range(1, given.ndim)))).tolist()
            raise UsageError(f"actions of copies {rows} are not finite", hint="the policy has diverged")
        return given.astype(space.dtype)

    def _seeds(self, seed: Any) -> np.ndarray:
        """Return a seed for each copy."""
        own = self.np_random.integers(_SEEDS, size=self.num_envs)
        if isinstance(seed, int | np.integer):
            own = int(seed) + np.arange(self.num_envs)
        elif seed is not None:
            given = list(seed)
            if len(given) != self.num_envs:
                raise UsageError(f"{len(given)} seeds were given for {self.num_envs} copies")
            own = np.array([o if s is None else int(s) for s, o in zip(given, own, strict=True)])
        return (own % _SEEDS).astype(np.uint32)

    def _mask(self, options: dict[str, Any] | None) -> np.ndarray | None:
        """Return which copies to reset; None: all."""
        if not options or "reset_mask" not in options:
            return None
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise UsageError(
                f"reset_mask must be bool of shape ({self.num_envs},) with a copy to reset, "
                f"got {mask.dtype} of shape {mask.shape}"
            )
        return mask


def _own(observation: Any) -> Any:
    """Return arrays that the caller may write into."""
    return jax.tree.map(np.array, observation)


def _masked(values: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return infos as gymnasium has them: each with a mask of the copies that it is of."""
    return {key: v for name, value in values.items() for key, v in ((name, np.array(value)), (f"_{name}", mask.copy()))}
