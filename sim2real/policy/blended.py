"""A policy that is let in slowly at the start of an episode."""

from __future__ import annotations

import numpy as np

from sim2real.policy.runner import PolicyRunner


class BlendedRunner:
    """A runner whose action grows from none to the policy's during the first part of each episode.

    Args:
        blend_s: How long that takes [s]; 0: the action is the policy's from the start.
    """

    def __init__(self, runner: PolicyRunner, blend_s: float) -> None:
        self._runner, self._steps, self._made = runner, blend_s * runner.contract.rate_hz, 0

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()
        self._made = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, shape ``(A,)``: a share of the policy's."""
        action, share = self._runner(observation), min(1.0, self._made / self._steps) if self._steps else 1.0
        self._made += 1
        return action * np.float32(share)
