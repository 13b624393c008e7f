"""Arithmetic on a caller's numbers: numpy arrays, or JAX arrays and tracers. Imports no JAX."""

import sys
from typing import Any

import numpy as np

from sim2real.types import Scalar


def is_jax(value: object) -> bool:
    """Return whether a value is a JAX array or tracer, without importing JAX."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.Array)


def namespace(*values: object) -> Any:
    """Return ``jax.numpy`` if one of the values, or an item of one, is an array of JAX; else ``numpy``."""
    for value in values:
        items = value if isinstance(value, list | tuple) else (value,)
        if any(is_jax(v) for v in items):
            import jax.numpy as jnp

            return jnp
    return np


def beside_damping(armature: Scalar, damping: Scalar, step_s: Scalar) -> Any:
    """Return the armature to set in a MuJoCo model: the rotor's inertia minus what the integrator adds, at least 0.

    MuJoCo integrates damping implicitly, which acts like an inertia of half a step times the damping: at 2.5 ms that is
    6 % of the rotors' inertia of pipelines/arm, and 0.0018 kg m^2 for a damping of 1.4 N m s/rad.
    """
    return namespace(armature, damping).maximum(armature - 0.5 * step_s * damping, 0.0)


def multiply_quaternions(a: Any, b: Any) -> Any:
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


def rotate(vector: Any, quaternion: Any) -> Any:
    """Return a vector ``(3,)`` rotated by a unit quaternion ``(4,)``, scalar first."""
    xp = namespace(vector, quaternion)
    w, axis = quaternion[0], quaternion[1:]
    turn = 2.0 * xp.cross(axis, vector)
    return vector + w * turn + xp.cross(axis, turn)
