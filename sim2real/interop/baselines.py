"""A gymnasium vector environment as a ``VecEnv`` of Stable-Baselines3, which has an interface of its own."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from sim2real.composer.interop.copies import AutoresetMode, CopiesVectorEnv
from sim2real.errors import Sim2RealError, UsageError


def to_baselines(env: CopiesVectorEnv, seed: int | None = None) -> Any:
    """Return a vector environment as a ``stable_baselines3.common.vec_env.VecEnv``.

    An episode that the time limit cut has ``TimeLimit.truncated`` in its info, and every one that ended
    ``terminal_observation``, from which Stable-Baselines3 takes the value of what would have followed.

    Args:
        env: Copies that start anew in the step that ends an episode, ``autoreset_mode="SameStep"``.
        seed: Seed of the episodes; default: a random one.

    Raises:
        Sim2RealError: When Stable-Baselines3 is not installed.
        UsageError: When copies start anew at another time.
    """
    if env.autoreset_mode is not AutoresetMode.SAME_STEP:
        raise UsageError(
            f"Stable-Baselines3 starts copies anew in the step that ends an episode, and this environment's mode is "
            f"{env.autoreset_mode.value!r}",
            hint="make it with autoreset_mode='SameStep'",
        )
    try:
        # By name: it comes with PyTorch, and is no dependency.
        base: Any = importlib.import_module("stable_baselines3.common.vec_env").VecEnv
    except ImportError as error:
        raise Sim2RealError(
            "Stable-Baselines3 is not installed", hint="pip install stable-baselines3, which installs PyTorch"
        ) from error

    kind: Any = type("BaselinesVecEnv", (_Copies, base), {})  # its base class is known only now
    made = kind(env.num_envs, env.single_observation_space, env.single_action_space)
    made.env = env
    made.seed(seed)
    return made


class _Copies:
    """The methods that Stable-Baselines3 asks for."""

    env: CopiesVectorEnv
    num_envs: int
    render_mode = None

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seed of the next reset; copy i has ``seed + i``."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> np.ndarray:
        """Start all copies."""
        observation, _ = self.env.reset(seed=self._seed)
        self._seed = None
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all copies."""
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        done = terminated | truncated
        told: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(cut)} for cut in truncated]
        for i in np.flatnonzero(done):
            final = infos["final_info"]
            told[i]["terminal_observation"] = infos["final_obs"][i]
            told[i] |= {name: value[i] for name, value in final.items() if not name.startswith("_")}
        return observation, reward.astype(np.float32), done, told

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, for each of some copies."""
        of = self if attr_name == "render_mode" else self.env
        return [getattr(of, attr_name) for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: copies are steps of one program, none has attributes of its own."""
        raise UsageError(f"copies have no attributes of their own: {attr_name!r} cannot be set")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> list[Any]:
        """Call a method of the environment once, and return its result for each of some copies."""
        result = getattr(self.env, method_name)(*args, **options)
        return [result for _ in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that no copy is wrapped."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: Any) -> Iterable[int]:
        if indices is None:
            return range(self.num_envs)
        return [indices] if isinstance(indices, int) else indices
