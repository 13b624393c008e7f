"""Places props without contacts, on C and, with a bounded number of attempts, in compiled programs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.errors import EpisodeInitializationError, PhysicsError
from sim2real.composer.initializer import Initializer
from sim2real.composer.variation.base import evaluate
from sim2real.errors import UsageError

if TYPE_CHECKING:
    import jax

    from sim2real.composer.entity import Entity
    from sim2real.composer.physics.c.physics import Physics
    from sim2real.composer.physics.mjx.physics import MjxPhysics
    from sim2real.composer.physics.mjx.random import JaxRandomState
    from sim2real.composer.types import Array, RandomState, Varying


class PropPlacer(Initializer):
    """Draws a pose for each prop in turn, until it touches neither the world nor the props before it.

    Args:
        position: Position ``(3,)`` [m], or a variation.
        quaternion: Orientation ``(4,)``, or a variation.
        ignore_collisions: Whether to take the first pose, with or without contacts.
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
        self._pose = position, quaternion
        self._ignore_collisions, self._max_attempts = ignore_collisions, max_attempts_per_prop

    def __call__(
        self, physics: Any, random_state: Any, ignore_contacts_with_entities: Iterable[Entity] | None = None
    ) -> None:
        """Place the props.

        Args:
            ignore_contacts_with_entities: Entities that props may touch, such as entities that are placed later.

        Raises:
            EpisodeInitializationError: No pose without contact was found for a prop; on MJX, ``physics.fail`` marks the
                copies.
        """
        place = self._place_on_mjx if hasattr(physics, "retry") else self._place
        place(physics, random_state, list(ignore_contacts_with_entities or ()))

    def _draw(self, prop: Entity, physics: Any, random_state: Any, first: Any, now: Any) -> list[Any]:
        """Set a new pose, and return it.

        Args:
            first: The pose at the start.
            now: The pose at present.
        """
        parts = zip(self._pose, first, now, strict=True)
        pose = [evaluate(varied, initial, current, random_state) for varied, initial, current in parts]
        prop.set_pose(physics, *pose)
        return pose

    # -- on C

    def _place(self, physics: Physics, random_state: RandomState, ignored: list[Entity]) -> None:
        # Switch contacts with unplaced props off, because buffers of contacts may be small.
        off = [_switch_off(physics, entity) for entity in (*self._props, *ignored)]
        try:
            physics.forward()
            for prop, contacts in zip(self._props, off, strict=False):
                _restore(contacts)
                if not self._find_place(physics, random_state, prop):
                    raise EpisodeInitializationError(
                        f"Failed to find a non-colliding pose for prop {prop.mjcf_model.model!r} within "
                        f"{self._max_attempts} attempts.",
                        hint="draw from a broader distribution, or raise max_attempts_per_prop",
                    )
        finally:  # also after a failure: the next attempt may run on the same model
            for contacts in off:
                _restore(contacts)

    def _find_place(self, physics: Physics, random_state: RandomState, prop: Entity) -> bool:
        pose: Any = [np.array(v) for v in prop.get_pose(physics)]
        first = pose
        for _ in range(self._max_attempts):
            pose = self._draw(prop, physics, random_state, first, pose)
            try:
                physics.forward()
            except PhysicsError:  # the contact buffer may be full: this pose collides
                continue
            if self._ignore_collisions or not _touches(physics, prop):
                return True
        return False

    # -- on MJX

    def _place_on_mjx(self, physics: MjxPhysics, random_state: JaxRandomState, ignored: list[Entity]) -> None:
        import jax.numpy as jnp

        from sim2real.composer.physics.mjx.stepping import is_warp

        if is_warp(physics.mjx_model) and not self._ignore_collisions:
            raise UsageError(
                "PropPlacer reads the contacts of a copy, and MJX-Warp stores contacts of all copies together",
                hint='use impl="jax", or ignore_collisions=True',
            )
        # Contacts cannot be switched off in a program, so ignore contacts with props that are placed later.
        numbers = [_geoms(physics, prop) for prop in self._props]
        passed = [n for prop in ignored for n in _geoms(physics, prop)]
        for i, prop in enumerate(self._props):
            later = jnp.array([*passed, *(n for other in numbers[i + 1 :] for n in other)], int)
            geoms, first = jnp.array(numbers[i], int), prop.get_pose(physics)

            def attempt(
                prop: Entity = prop,
                geoms: jax.Array = geoms,
                later: jax.Array = later,
                first: tuple[Array, Array] = first,
            ) -> None:
                self._draw(prop, physics, random_state, first, first)
                if not self._ignore_collisions and not physics.dry:
                    physics.fail(_touches_on_mjx(physics, geoms, later))

            physics.fail(physics.retry(attempt, random_state, self._max_attempts))


def _geoms(physics: Any, prop: Entity) -> list[int]:
    return [int(i) for i in physics.bind(prop.mjcf_model.find_all("geom")).element_id]


_Contacts = tuple[Any, np.ndarray, np.ndarray]
"""Bound geoms, and their contact masks."""


def _switch_off(physics: Physics, entity: Entity) -> _Contacts | None:
    """Switch contacts with an entity off; return its contact masks to restore them, None without geoms."""
    geoms = physics.bind(entity.mjcf_model.find_all("geom"))
    if not len(geoms.element_id):
        return None
    before = geoms, geoms.contype.copy(), geoms.conaffinity.copy()
    geoms.contype, geoms.conaffinity = 0, 0
    return before


def _restore(contacts: _Contacts | None) -> None:
    if contacts is not None:
        geoms, contype, conaffinity = contacts
        geoms.contype, geoms.conaffinity = contype, conaffinity


def _touches(physics: Physics, prop: Entity) -> bool:
    """Return whether a prop touches anything."""
    contact, geoms = physics.data.contact, _geoms(physics, prop)
    hit = np.isin(contact.geom1, geoms) | np.isin(contact.geom2, geoms)
    return bool(np.any(hit & (contact.dist <= 0)))


def _touches_on_mjx(physics: MjxPhysics, geoms: jax.Array, later: jax.Array) -> jax.Array:
    """Return whether a geom of a prop touches a geom that is not placed later."""
    import jax.numpy as jnp

    from sim2real.composer.physics.mjx.import_mjx import held_links, mjx

    model = physics.mjx_model
    with held_links():
        data = mjx.collision(model, mjx.com_pos(model, mjx.kinematics(model, physics.mjx_data)))
    impl: Any = data._impl
    contact = impl.contact
    pair = jnp.stack([contact.geom1, contact.geom2])
    hit = (contact.dist <= 0) & jnp.isin(pair, geoms).any(axis=0) & ~jnp.isin(pair, later).any(axis=0)
    return hit.any()
