"""Aliases of types, for annotations. Imports JAX and MuJoCo only for type checkers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

PyTree: TypeAlias = Any
"""A tree of arrays (a pytree of JAX): a message, a state, parameters."""
Json: TypeAlias = Any
"""A value of JSON: a number, a text, a boolean, a list or dict of such values, or None."""

if TYPE_CHECKING:
    import jax
    import numpy as np
    from mujoco._specs import MjSpec as MjSpec
    from mujoco._structs import MjData as MjData
    from mujoco._structs import MjModel as MjModel

    Array: TypeAlias = jax.Array | np.ndarray
    """Numbers of NumPy, or of JAX inside and outside of a traced function."""
    Scalar: TypeAlias = float | Array
    """One number; an array of shape ``()`` inside of a traced function."""
    Key: TypeAlias = jax.Array
    """A key of JAX's random numbers."""
else:
    Array = Scalar = Key = MjSpec = MjData = MjModel = Any
