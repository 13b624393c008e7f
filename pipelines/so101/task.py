"""Reach for a target with the point between the jaws, opened to a commanded width, and stay there."""

from __future__ import annotations

from typing import Any

from sim2real.robots.servo.parts import GoalTask

from .parts import SHAPES, STEP_S, TIP_M, Arm, Table

CLOSE_M, CLOSE_RAD = 0.02, 0.1
"""How near tip and jaw must come [m], [rad]."""


def tip_of(np_: Any, position: Any) -> Any:
    """Return where the point between the jaws is ``(..., 3)`` [m] for joint angles ``(..., 6)`` [rad].

    Args:
        np_: ``numpy`` or ``jax.numpy``.
        position: In the order of ``parts.JOINTS``.
    """
    pan, pitch = position[..., 0], position[..., 1]
    out, height = SHAPES[1].at[0], SHAPES[0].at[2] + SHAPES[1].at[2]
    hand = SHAPES[4].at[0] + TIP_M
    for joint, (x, _, z) in enumerate((SHAPES[2].at, SHAPES[3].at, (hand, 0.0, 0.0)), 2):
        c, s = np_.cos(pitch), np_.sin(pitch)
        out, height = out + c * x + s * z, height - s * x + c * z
        pitch = pitch + position[..., joint]
    return np_.stack([SHAPES[0].at[0] + out * np_.cos(pan), -out * np_.sin(pan), height], axis=-1)


class Reach(GoalTask):
    """The arm starts where its joints are; the reward is highest at the target with the jaw open as commanded."""

    robot: Arm

    def __init__(self) -> None:
        self.robot, self.table = Arm(), Table()
        self.table.attach(self.robot)
        self.set_timesteps(control_timestep=0.01, physics_timestep=STEP_S)

    @property
    def root_entity(self) -> Any:
        """The table."""
        return self.table

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """The target counts as far until the first step."""
        del random_state
        physics.variables["distance"] = physics.variables["ajar"] = physics.np.asarray(physics.np.inf)

    def after_step(self, physics: Any, random_state: Any) -> None:
        """Measure how far tip and jaw are off."""
        del random_state
        gap = physics.bind(self.robot.tip).xpos - physics.bind(self.table.target).xpos
        # The square root has no derivative at 0.
        physics.variables["distance"] = physics.np.sqrt(physics.np.sum(gap**2) + 1e-12)
        opening = physics.bind(self.table.opening).pos[0]
        physics.variables["ajar"] = physics.np.abs(physics.bind(self.joints).qpos[5] - opening)

    def get_reward(self, physics: Any) -> Any:
        """Return up to 2.5 at the target, less than 0 far away."""
        distance, ajar = physics.variables["distance"], physics.variables["ajar"]
        near, nearer = (physics.np.exp(-((distance / size) ** 2)) for size in (0.1, CLOSE_M))
        return near + nearer - 2.0 * distance + 0.5 * physics.np.exp(-((ajar / CLOSE_RAD) ** 2)) - 0.3 * ajar
