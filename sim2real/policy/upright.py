"""A policy that is let act only while the robot leans less than it may."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sim2real.errors import SafetyStop


class Runner(Protocol):
    """What runs a policy; see ``sim2real.policy.PolicyRunner``."""

    def reset(self) -> None:
        """Begin an episode."""
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action ``(A,)`` for the next observation ``(O,)``."""
        ...


class UprightRunner:
    """A runner that stops the robot when it leans too far.

    Args:
        tilt_rad: Returns how far the robot leans, from an observation ``(O,)`` [rad].
        limit_rad: How far it may [rad].
    """

    def __init__(self, runner: Runner, tilt_rad: Callable[[np.ndarray], float], limit_rad: float) -> None:
        self._runner, self._tilt_rad, self._limit_rad = runner, tilt_rad, limit_rad

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action, shape ``(A,)``.

        Raises:
            SafetyStop: The robot leans further than it may, or its tilt is no number.
        """
        tilt_rad = self._tilt_rad(observation)
        if not abs(tilt_rad) <= self._limit_rad:
            raise SafetyStop(
                f"the robot leans by {tilt_rad:.3g} rad, {self._limit_rad:.3g} rad are allowed",
                hint="set it upright; max_tilt_rad sets what is allowed",
            )
        return self._runner(observation)
