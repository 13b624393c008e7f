"""A policy that acts only while the robot's tilt is below a limit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sim2real.errors import SafetyStop


class Runner(Protocol):
    """A runner of a policy; see ``sim2real.policy.PolicyRunner``."""

    def reset(self) -> None:
        """Begin an episode."""
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action ``(A,)`` for the next observation ``(O,)``."""
        ...


class UprightRunner:
    """A runner that stops the robot above a tilt limit.

    Args:
        tilt_rad: Returns the robot's tilt from an observation ``(O,)`` [rad].
        limit_rad: Largest allowed tilt [rad].
    """

    def __init__(self, runner: Runner, tilt_rad: Callable[[np.ndarray], float], limit_rad: float) -> None:
        self._runner, self._tilt_rad, self._limit_rad = runner, tilt_rad, limit_rad

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action, shape ``(A,)``.

        Raises:
            SafetyStop: The robot's tilt is above the limit, or no number.
        """
        tilt_rad = self._tilt_rad(observation)
        if not abs(tilt_rad) <= self._limit_rad:
            raise SafetyStop(
                f"the robot leans by {tilt_rad:.3g} rad, more than the {self._limit_rad:.3g} rad that are allowed",
                hint="set it upright; max_tilt_rad sets the limit",
            )
        return self._runner(observation)
