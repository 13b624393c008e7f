"""A policy whose actions grow from 0 at the start of an episode."""

from __future__ import annotations

import numpy as np

from sim2real.policy.runner import PolicyRunner


class BlendedRunner:
    """A runner whose action grows linearly from 0 to the policy's action at the start of each episode.

    Args:
        blend_s: Time until the action is the policy's [s]; 0: from the start.
    """

    def __init__(self, runner: PolicyRunner, blend_s: float) -> None:
        self._runner, self._blend_steps, self._step = runner, blend_s * runner.contract.rate_hz, 0

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()
        self._step = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return a share of the policy's action, shape ``(A,)``."""
        action = self._runner(observation)
        share = min(1.0, self._step / self._blend_steps) if self._blend_steps else 1.0
        self._step += 1
        return action * np.float32(share)
