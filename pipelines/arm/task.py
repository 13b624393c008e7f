"""Reach for a target with the tip, and stay there."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim2real.robots.servo.parts import GoalTask

from .parts import GANTRY_M, LINK_M, SHOULDER_M, Arm, Gantry

CLOSE_M = 0.02
"""How near the tip must come [m]."""
LOW, HIGH = (-1.2, -0.3, -0.2), (1.2, 1.2, 1.4)
"""Joint angles between which targets are drawn [rad]: every target can be reached."""


def tip_of(np_: Any, position: Any) -> Any:
    """Return where the tip is ``(..., 3)`` [m] for joint angles ``(..., 3)`` [rad]; all 0: straight down.

    Args:
        np_: ``numpy`` or ``jax.numpy``.
        position: Pan, shoulder, elbow.
    """
    pan, upper = position[..., 0], position[..., 1]
    fore = upper + position[..., 2]
    out = SHOULDER_M[0] + LINK_M * (np_.sin(upper) + np_.sin(fore))
    height = GANTRY_M + SHOULDER_M[1] - LINK_M * (np_.cos(upper) + np_.cos(fore))
    return np_.stack([out * np_.cos(pan), out * np_.sin(pan), height], axis=-1)


class Reach(GoalTask):
    """The arm starts as it hangs; the reward is highest at the target.

    Args:
        draw_target: Whether each episode draws its own; otherwise the target stays where the model has it.
    """

    robot: Arm

    def __init__(self, draw_target: bool = True) -> None:
        self.robot, self.gantry = Arm(), Gantry()
        self.gantry.attach(self.robot, self.gantry.mount)
        self._draw_target = draw_target
        self.set_timesteps(control_timestep=0.01, physics_timestep=0.0025)

    @property
    def root_entity(self) -> Any:
        """The gantry."""
        return self.gantry

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Place the target."""
        if self._draw_target:
            angles = random_state.uniform(np.array(LOW), np.array(HIGH), 3)
            physics.bind(self.gantry.target).pos = tip_of(physics.np, physics.np.asarray(angles))
        physics.variables["distance"] = physics.np.asarray(physics.np.inf)  # until the first step

    def after_step(self, physics: Any, random_state: Any) -> None:
        """Measure the distance."""
        del random_state
        physics.variables["distance"] = self.distance(physics)

    def distance(self, physics: Any) -> Any:
        """Return how far the tip is from the target [m]."""
        gap = physics.bind(self.robot.tip).xpos - physics.bind(self.gantry.target).xpos
        # The square root has no derivative at 0.
        return physics.np.sqrt(physics.np.sum(gap**2) + 1e-12)

    def get_reward(self, physics: Any) -> Any:
        """Return up to 2 at the target, less than 0 far away."""
        distance = physics.variables["distance"]
        near, nearer = (physics.np.exp(-((distance / size) ** 2)) for size in (0.1, CLOSE_M))
        return near + nearer - 2.0 * distance
