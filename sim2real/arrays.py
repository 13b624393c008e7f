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
    """Return ``jax.numpy`` when one of the values, or of their items, is JAX's; else ``numpy``."""
    for value in values:
        items = value if isinstance(value, list | tuple) else (value,)
        if any(is_jax(v) for v in items):
            import jax.numpy as jnp

            return jnp
    return np


def beside_damping(armature: Scalar, damping: Scalar, step_s: Scalar) -> Any:
    """Return the armature to set in a model of MuJoCo: the rotor's, without what its integrator adds; 0 at least.

    MuJoCo integrates damping implicitly, which acts like an inertia of half a step times the damping: at 2.5 ms that is
    6 % of the rotors' inertia of pipelines/arm, and 0.0018 kg m^2 for a damping of 1.4 N m s/rad.
    """
    return namespace(armature, damping).maximum(armature - 0.5 * step_s * damping, 0.0)
