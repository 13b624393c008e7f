"""Placing props without contacts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer import variation
from sim2real.composer.errors import EpisodeInitializationError, PhysicsError
from sim2real.composer.initializer import Initializer

if TYPE_CHECKING:
    from sim2real.composer.entity import Entity
    from sim2real.composer.physics.c.physics import Physics
    from sim2real.composer.types import RandomState, Varying

_Contacts = tuple[Any, Any, Any]
"""Bound geoms, and which contacts they had; Nones where an entity has no geoms."""


class PropPlacer(Initializer):
    """Draws a pose for each prop in turn, until it has no contact.

    Args:
        position: Position ``(3,)`` [m], or a variation.
        quaternion: Orientation ``(4,)``, or a variation.
        ignore_collisions: Take the first pose, with or without contacts.
    """

    def __init__(
        self,
        props: Iterable[Entity],
        position: Varying,
        quaternion: Varying = (1.0, 0.0, 0.0, 0.0),
        ignore_collisions: bool = False,
        max_attempts_per_prop: int = 20,
    ) -> None:
        self._props = list(props)
        self._position, self._quaternion = position, quaternion
        self._ignore_collisions, self._max_attempts = ignore_collisions, max_attempts_per_prop

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
            from sim2real.composer.physics.mjx.placing import place

            pose = (self._position, self._quaternion)
            place(physics, random_state, self._props, pose, self._max_attempts, self._ignore_collisions, ignored)
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
            self._place(physics, random_state, cached)
        finally:  # also after a failure: the next attempt may run on the same model
            for contacts in cached:
                _restore(contacts)

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
