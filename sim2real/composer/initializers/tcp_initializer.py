"""Bringing the tool of an arm to a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer import variation
from sim2real.composer.errors import EpisodeInitializationError
from sim2real.composer.initializer import Initializer
from sim2real.composer.initializers import inverse_kinematics
from sim2real.composer.models.mjcf.translate import mj
from sim2real.composer.models.traversal import get_freejoint
from sim2real.composer.robot import DOWN_QUATERNION
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.element import Element
    from sim2real.composer.physics.c.physics import Physics
    from sim2real.composer.types import ArrayLike, RandomState, Varying


class ToolCenterPointInitializer(Initializer):
    """Draws poses of a tool until the arm reaches one without touching itself or what stands fast.

    Args:
        hand: An entity with a site ``tool_center_point``; None: the arm's ``wrist_site`` is the tool.
        arm: An entity with ``joints`` and ``wrist_site``; its own ``set_site_to_xpos`` moves it, if it has one.
        position: Of the tool in the world, ``(3,)`` [m], or a variation.
        quaternion: Of the tool in the world, ``(4,)``, or a variation; default: pointing down.
        ignore_collisions: Take the first pose that is reached.
        max_ik_attempts: Positions of the joints to start from for each pose: as they are, then by chance.
    """

    def __init__(
        self,
        hand: Any,
        arm: Any,
        position: Varying,
        quaternion: Varying = DOWN_QUATERNION,
        ignore_collisions: bool = False,
        max_ik_attempts: int = 10,
        max_rejection_samples: int = 10,
    ) -> None:
        self._hand, self._arm = hand, arm
        self._position, self._quaternion = position, quaternion
        self._ignore_collisions = ignore_collisions
        self._attempts, self._samples = max_ik_attempts, max_rejection_samples

    def __call__(self, physics: Any, random_state: RandomState) -> None:
        """Move the arm.

        Raises:
            EpisodeInitializationError: When no pose was reached without contact.
            UsageError: On MJX.
        """
        # Refuse MJX, whose resets cannot repeat.
        if hasattr(physics, "retry"):
            raise UsageError(
                "ToolCenterPointInitializer does not run on MJX: it tries until it succeeds",
                hint="draw positions of joints with random_state instead, or use composer.Environment",
            )
        site = self._arm.wrist_site if self._hand is None else self._hand.tool_center_point
        # Draw poses until the arm reaches one without contact; each begins from the same joint positions.
        before = physics.bind(self._arm.joints).qpos.copy()
        for _ in range(self._samples):
            pose = [variation.evaluate(v, random_state=random_state) for v in (self._position, self._quaternion)]
            if self._reach(physics, random_state, site, *pose):
                physics.forward()
                if self._ignore_collisions or not self._touches(physics):
                    return
            physics.bind(self._arm.joints).qpos = before
        raise EpisodeInitializationError(
            "Failed to find a valid initial configuration for the robot after "
            f"{self._samples} TCP poses sampled and up to {self._attempts} initial joint configurations per pose.",
            hint="sample from a broader distribution, raise max_rejection_samples, or set ignore_collisions",
        )

    def _reach(
        self, physics: Physics, random_state: RandomState, site: Element, position: ArrayLike, quaternion: ArrayLike
    ) -> bool:
        # Use the arm's own solver if it has one.
        solve = getattr(self._arm, "set_site_to_xpos", None)
        if solve is not None:
            return solve(
                physics=physics,
                random_state=random_state,
                site=site,
                target_pos=position,
                target_quat=quaternion,
                max_ik_attempts=self._attempts,
            )
        # Solve from the present joint positions, then from random ones.
        low, high = self._limits(physics)
        joints = physics.bind(self._arm.joints)
        for attempt in range(self._attempts):
            if attempt:
                joints.qpos = random_state.uniform(low, high)
            if inverse_kinematics.reach(physics, site, self._arm.joints, position, quaternion):
                turns = low + np.mod(joints.qpos - low, 2.0 * np.pi)  # the same angle at or above the lower limit
                joints.qpos = np.where(joints.type == int(mj.mjtJoint.mjJNT_HINGE), turns, joints.qpos)
                if np.all((joints.qpos >= low) & (joints.qpos <= high)):
                    return True
        return False

    def _limits(self, physics: Physics) -> np.ndarray:
        """Return the lowest and the highest positions of the joints, shape ``(2, n)``; hinges without: a turn."""
        joints = physics.bind(self._arm.joints)
        limits, limited = np.array(joints.range), np.asarray(joints.limited, bool)
        hinges = np.asarray(joints.type) == int(mj.mjtJoint.mjJNT_HINGE)
        endless = [j.full_identifier for j, bad in zip(self._arm.joints, ~hinges & ~limited, strict=True) if bad]
        if endless:
            raise UsageError(f"joints that are no hinges must have limits: {', '.join(endless)}")
        limits[~limited] = 0.0, 2.0 * np.pi
        return limits.T

    def _touches(self, physics: Physics) -> bool:
        """Return whether the arm touches itself or the hand, or one of both touches a fixed part of the world."""
        arm = self._numbers(physics, self._arm.mjcf_model.find_all("geom", exclude_attachments=True))
        hand = [] if self._hand is None else self._hand.mjcf_model.find_all("geom", exclude_attachments=True)
        robot = arm | self._numbers(physics, hand)
        world = self._arm.mjcf_model.root_model
        bodies = world.worldbody.find_all("body", immediate_children_only=True)
        free = self._numbers(physics, [g for b in bodies if get_freejoint(b) for g in b.find_all("geom")])
        for contact in physics.data.contact:
            pair = {int(contact.geom1), int(contact.geom2)}
            if contact.dist > 0 or not pair & robot:
                continue
            within = pair <= robot and bool(pair & arm)  # parts of the hand may touch one another
            if within or not pair <= robot | free:
                return True
        return False

    def _numbers(self, physics: Physics, geoms: list[Element]) -> set[int]:
        return set(np.atleast_1d(physics.bind(geoms).element_id).tolist())
