"""A gymnasium vector environment as a ``VecEnv`` of Stable-Baselines3."""

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.interop.vector import AutoresetMode, CopiesVectorEnv
from sim2real.types import PyTree

Indices = int | Iterable[int] | None
"""Indices of copies; None: all."""


def to_baselines(env: CopiesVectorEnv, seed: int | None = None) -> Any:
    """Return a vector environment as a ``stable_baselines3.common.vec_env.VecEnv``.

    At the end of an episode, infos have ``terminal_observation``, and ``TimeLimit.truncated`` if a time limit ended it:
    from these Stable-Baselines3 estimates the value of the state after the episode.

    Args:
        env: Environment whose ``autoreset_mode`` is ``"SameStep"``.
        seed: Seed of the episodes; default: a random one.

    Raises:
        Sim2RealError: Stable-Baselines3 is not installed.
        UsageError: Copies are reset in another step.
    """
    if env.autoreset_mode is not AutoresetMode.SAME_STEP:
        raise UsageError(
            f"Stable-Baselines3 resets copies in the step that ends an episode, and this environment's mode is "
            f"{env.autoreset_mode.value!r}",
            hint="make it with autoreset_mode='SameStep'",
        )
    try:
        # Import by name: Stable-Baselines3 installs PyTorch, so it is no dependency.
        base: Any = importlib.import_module("stable_baselines3.common.vec_env").VecEnv
    except ImportError as error:
        raise Sim2RealError(
            "Stable-Baselines3 is not installed", hint="pip install stable-baselines3, which installs PyTorch"
        ) from error

    # The adapter inherits from their class, so it is defined here.
    adapted: Any = type("BaselinesVecEnv", (_Copies, base), {"env": env, "_seed": seed})
    return adapted(env.num_envs, env.single_observation_space, env.single_action_space)


class _Copies:
    """The methods that Stable-Baselines3 calls; all copies run in one program, and have no attributes of their own."""

    env: CopiesVectorEnv
    num_envs: int
    render_mode = None
    _seed: int | None

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seed of the next reset; copy i has ``seed + i``."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> np.ndarray:
        observation, _ = self.env.reset(seed=self._seed)
        self._seed = None
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, PyTree]]]:
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        done = terminated | truncated
        copy_infos: list[dict[str, PyTree]] = [{"TimeLimit.truncated": bool(cut)} for cut in truncated]
        for i in np.flatnonzero(done):
            copy_infos[i]["terminal_observation"] = infos["final_obs"][i]
            copy_infos[i] |= {n: value[i] for n, value in infos["final_info"].items() if not n.startswith("_")}
        return observation, reward.astype(np.float32), done, copy_infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[object]:
        owner = self if attr_name == "render_mode" else self.env
        return self._for_each(getattr(owner, attr_name), indices)

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        raise UsageError(f"copies have no attributes of their own: {attr_name!r} cannot be set")

    def env_method(self, method_name: str, *args: object, indices: Indices = None, **options: object) -> list[object]:
        return self._for_each(getattr(self.env, method_name)(*args, **options), indices)

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[object]:
        return self._for_each(False, indices)

    def _for_each(self, value: object, indices: Indices) -> list[object]:
        if indices is None:
            return [value] * self.num_envs
        return [value for _ in ([indices] if isinstance(indices, int) else indices)]
