"""Arithmetic on the arrays of both engines: numpy arrays, or JAX arrays and tracers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.arrays import is_jax as is_jax
from sim2real.arrays import namespace as namespace

if TYPE_CHECKING:
    from sim2real.composer.types import Array


def multiply_quaternions(a: Array, b: Array) -> Array:
    """Return the product of two quaternions ``(4,)``, scalar first: first rotate by b, then by a."""
    xp = namespace(a, b)
    w1, x1, y1, z1 = (a[i] for i in range(4))
    w2, x2, y2, z2 = (b[i] for i in range(4))
    return xp.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ]
    )


def rotate(vector: Array, quaternion: Array) -> Array:
    """Return a vector ``(3,)`` rotated by a unit quaternion ``(4,)``, scalar first."""
    xp = namespace(vector, quaternion)
    w, axis = quaternion[0], quaternion[1:]
    turn = 2.0 * xp.cross(axis, vector)
    return vector + w * turn + xp.cross(axis, turn)
