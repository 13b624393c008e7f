"""Arithmetic on whatever an engine computes with: numpy arrays, or JAX arrays and tracers."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sim2real.composer.types import Array


def is_jax(value: object) -> bool:
    """Return whether a value is a JAX array or tracer, without importing JAX."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.Array)


def namespace(*values: object) -> Any:
    """Return ``jax.numpy`` when one of the values, or of their items, is JAX's; else ``numpy``."""
    for value in values:
        items = value if isinstance(value, list | tuple) else (value,)
        if any(is_jax(v) for v in items):
            import jax.numpy as jnp

            return jnp
    return np


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
