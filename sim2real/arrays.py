"""Arithmetic on a caller's numbers: numpy arrays, or JAX arrays and tracers. Imports no JAX."""

import sys
from typing import Any

import numpy as np


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
