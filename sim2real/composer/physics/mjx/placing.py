"""Placing props inside a compiled program: poses are drawn until nothing touches, a bounded number of times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from mujoco import mjx

from sim2real.composer.physics.mjx.import_mjx import held_links
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.physics.mjx.random import JaxRandomState
from sim2real.composer.physics.mjx.stepping import is_warp
from sim2real.composer.variation.base import evaluate
from sim2real.errors import UsageError

if TYPE_CHECKING:
    import jax

    from sim2real.composer.entity import Entity
    from sim2real.composer.types import Array, Varying


def place(
    physics: MjxPhysics,
    random_state: JaxRandomState,
    props: Sequence[Entity],
    pose: tuple[Varying, Varying],
    attempts: int,
    ignore_collisions: bool,
    ignored: Sequence[Entity],
) -> None:
    """Place one prop after the other where it touches neither the world nor the props before it.

    Contacts cannot be switched off inside a program, so those with props that are not placed yet do not count.

    Args:
        physics: The physics; ``physics.fail`` is called where a prop found no place.
        pose: Position ``(3,)`` [m] and quaternion ``(4,)``, or variations.
    """
    if is_warp(physics.mjx_model) and not ignore_collisions:
        raise UsageError(
            "PropPlacer looks at the contacts of a copy, and MJX-Warp keeps those of all copies together",
            hint='use impl="jax", or ignore_collisions=True',
        )
    # Place the props in order; contacts with later ones do not count.
    numbers = [_geoms(physics, prop) for prop in props]
    passed = [n for prop in ignored for n in _geoms(physics, prop)]
    for i, prop in enumerate(props):
        later = jnp.array([*passed, *(n for other in numbers[i + 1 :] for n in other)], int)
        geoms = jnp.array(numbers[i], int)
        initial = prop.get_pose(physics)

        def attempt(
            prop: Entity = prop,
            geoms: jax.Array = geoms,
            later: jax.Array = later,
            initial: tuple[Array, Array] = initial,
        ) -> None:
            drawn = [evaluate(p, x, x, random_state) for p, x in zip(pose, initial, strict=True)]
            prop.set_pose(physics, *drawn)
            if not ignore_collisions:
                physics.fail(_touches(physics, geoms, later))

        physics.fail(physics.retry(attempt, random_state, attempts))


def _geoms(physics: MjxPhysics, prop: Entity) -> list[int]:
    return [int(i) for i in physics.bind(prop.mjcf_model.find_all("geom")).element_id]


def _touches(physics: MjxPhysics, geoms: jax.Array, later: jax.Array) -> jax.Array:
    """Return whether a geom of a prop touches one that counts."""
    if physics.dry:
        return jnp.zeros((), bool)
    model = physics.mjx_model
    with held_links():
        data = mjx.collision(model, mjx.com_pos(model, mjx.kinematics(model, physics.mjx_data)))
    impl: Any = data._impl
    contact = impl.contact
    pair = jnp.stack([contact.geom1, contact.geom2])
    hit = (contact.dist <= 0) & jnp.isin(pair, geoms).any(axis=0) & ~jnp.isin(pair, later).any(axis=0)
    return hit.any()
