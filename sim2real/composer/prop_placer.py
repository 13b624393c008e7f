"""Placing props without contacts."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer import variation
from sim2real.composer.errors import EpisodeInitializationError, PhysicsError
from sim2real.composer.initializer import Initializer
from sim2real.composer.mjcf import get_frame_freejoint
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.entity import Entity
    from sim2real.composer.physics.c.physics import Physics
    from sim2real.composer.physics.mjx.physics import MjxPhysics
    from sim2real.composer.physics.mjx.random import JaxRandomState
    from sim2real.composer.types import RandomState, Varying

_log = logging.getLogger(__name__)


_Contacts = tuple[Any, Any, Any]
"""Bound geoms, and which contacts they had; Nones where an entity has no geoms."""


class PropPlacer(Initializer):
    """Draws a pose for each prop in turn, until it has no contact; then simulates until they settle, if configured.

    Args:
        position: Position ``(3,)`` [m], or a variation.
        quaternion: Orientation ``(4,)``, or a variation.
        ignore_collisions: Take the first pose, with or without contacts.
        max_qvel_tol: Velocity below which a prop has settled [rad/s or m/s].
        max_qacc_tol: Acceleration below which a prop has settled [rad/s^2 or m/s^2].
        settle_physics: Let the physics run until the props rest; everything else is held.
        min_settle_physics_time: Shortest time to settle [s].
        max_settle_physics_time: Longest time to settle [s].
        max_settle_physics_attempts: How often all props are placed again when they do not come to rest.
        raise_exception_on_settle_failure: Raise an error rather than warn.

    Raises:
        UsageError: When ``max_settle_physics_attempts`` is below 1.
    """

    def __init__(
        self,
        props: Iterable[Entity],
        position: Varying,
        quaternion: Varying = (1.0, 0.0, 0.0, 0.0),
        ignore_collisions: bool = False,
        max_qvel_tol: float = 1e-3,
        max_qacc_tol: float = 1e-2,
        max_attempts_per_prop: int = 20,
        settle_physics: bool = False,
        min_settle_physics_time: float = 0.0,
        max_settle_physics_time: float = 2.0,
        max_settle_physics_attempts: int = 1,
        raise_exception_on_settle_failure: bool = False,
    ) -> None:
        if max_settle_physics_attempts < 1:
            raise UsageError(
                "max_settle_physics_attempts should be greater than zero to have any effect, "
                f"but is {max_settle_physics_attempts}"
            )
        self._props = list(props)
        self._position, self._quaternion = position, quaternion
        self._ignore_collisions, self._max_attempts = ignore_collisions, max_attempts_per_prop
        self._qvel_tol, self._qacc_tol = max_qvel_tol, max_qacc_tol
        self._settles, self._settle_attempts = settle_physics, max_settle_physics_attempts
        self._min_time, self._max_time = min_settle_physics_time, max_settle_physics_time
        self._raises = raise_exception_on_settle_failure
        self._joints = []
        for prop in self._props:
            free = get_frame_freejoint(prop.mjcf_model)
            joints = prop.mjcf_model.find_all("joint")
            self._joints += joints if free is None or free in joints else [free, *joints]

    def __call__(
        self, physics: Any, random_state: Any, ignore_contacts_with_entities: Iterable[Entity] | None = None
    ) -> None:
        """Place the props.

        Args:
            ignore_contacts_with_entities: Entities that may be touched, such as those that are placed later.

        Raises:
            EpisodeInitializationError: When no pose without contact was found for a prop.
        """
        ignored = list(ignore_contacts_with_entities or ())
        if hasattr(physics, "retry"):
            self._place_on_mjx(physics, random_state, ignored)
            return
        cached = [self._disable_contacts(physics, prop) for prop in (*self._props, *ignored)]
        try:
            try:
                physics.forward()
            except PhysicsError as error:
                raise PhysicsError(
                    "Despite disabling contact for all props in this initializer, `physics.forward()` resulted in a "
                    f"`PhysicsError`: {error}"
                ) from error
            if self._settles:
                self._place_and_settle(physics, random_state, cached)
            else:
                self._place(physics, random_state, cached)
        finally:  # also after a failure: the next attempt may run on the same model
            for contacts in cached:
                _restore(contacts)

    def _place_on_mjx(self, physics: MjxPhysics, random_state: JaxRandomState, ignored: list[Entity]) -> None:
        """Place the props inside a compiled program; ``physics.fail`` marks the copies without a place."""
        from sim2real.composer.physics.mjx.placing import place

        if self._settles:
            raise UsageError(
                "PropPlacer cannot settle physics on MJX: how long that takes differs from copy to copy",
                hint="set settle_physics=False, or step the environment until the props rest",
            )
        pose = (self._position, self._quaternion)
        place(physics, random_state, self._props, pose, self._max_attempts, self._ignore_collisions, ignored)

    def _disable_contacts(self, physics: Physics, entity: Entity) -> _Contacts:
        """Switch contacts with an entity off; return what brings them back. Contact buffers may be small."""
        geoms = physics.bind(entity.mjcf_model.find_all("geom"))
        if not len(geoms.element_id):
            return None, None, None
        before = geoms, geoms.contype.copy(), geoms.conaffinity.copy()
        geoms.contype, geoms.conaffinity = 0, 0
        return before

    def _place(self, physics: Physics, random_state: RandomState, cached: list[_Contacts]) -> None:
        for prop, contacts in zip(self._props, cached, strict=False):
            _restore(contacts)
            if not self._place_one(physics, random_state, prop):
                raise EpisodeInitializationError(
                    f"Failed to find a non-colliding pose for prop {prop.mjcf_model.model!r} within "
                    f"{self._max_attempts} attempts.",
                    hint="sample from a broader distribution, raise max_attempts_per_prop, or set ignore_collisions",
                )
        for contacts in cached[len(self._props) :]:
            _restore(contacts)

    def _place_one(self, physics: Physics, random_state: RandomState, prop: Entity) -> bool:
        initial = tuple(np.array(v) for v in prop.get_pose(physics))
        pose = initial
        for _ in range(self._max_attempts):
            drawn = (self._position, self._quaternion)
            pose = tuple(
                variation.evaluate(v, initial_value=i, current_value=c, random_state=random_state)
                for v, i, c in zip(drawn, initial, pose, strict=True)
            )
            prop.set_pose(physics, *pose)
            try:
                physics.forward()
            except PhysicsError:  # the contact buffer may be full: this pose collides
                continue
            if self._ignore_collisions or not _touches(physics, prop):
                return True
        return False

    def _place_and_settle(self, physics: Physics, random_state: RandomState, cached: list[_Contacts]) -> None:
        speed = acceleration = np.inf
        moving = physics.bind(self._joints)
        for _ in range(self._settle_attempts):
            self._place(physics, random_state, cached)
            start = physics.data.time
            # Run the physics until the props rest; the time of the physics does not count.
            held, positions, velocities = self._held_joints(physics)
            try:
                while physics.data.time - start < self._max_time:
                    physics.step()
                    if positions.size:
                        held.qpos, held.qvel = positions, velocities
                    speed, acceleration = np.abs(moving.qvel).max(), np.abs(moving.qacc).max()
                    rests = speed < self._qvel_tol and acceleration < self._qacc_tol
                    if rests and physics.data.time - start > self._min_time:
                        return
            finally:
                physics.data.time = start
        # The props did not settle: raise, or warn.
        message = (
            f"Failed to settle physics after {self._settle_attempts} attempts of {self._max_time} seconds. "
            f"Last residual velocity={speed} and acceleration={acceleration}."
        )
        if self._raises:
            raise EpisodeInitializationError(
                message, hint="raise max_settle_physics_time or max_settle_physics_attempts"
            )
        _log.warning(message)

    def _held_joints(self, physics: Physics) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return all joints but those of the props, bound, and their present positions and velocities."""
        root = self._joints[0].root.root_model
        bound = physics.bind([j for j in root.find_all("joint") if j not in self._joints])
        return bound, bound.qpos.copy(), bound.qvel.copy()


def _restore(contacts: _Contacts) -> None:
    geoms, contype, conaffinity = contacts
    if geoms is not None:
        geoms.contype, geoms.conaffinity = contype, conaffinity


def _touches(physics: Physics, prop: Entity) -> bool:
    """Return whether a prop touches anything."""
    geoms = physics.bind(prop.mjcf_model.find_all("geom")).element_id
    contact = physics.data.contact
    hit = np.isin(contact.geom1, geoms) | np.isin(contact.geom2, geoms)
    return bool(np.any(hit & (contact.dist <= 0)))
