"""Helpers over pytrees whose leaves share leading axes."""

from typing import TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


def tree_dynamic_slice(tree: T, start_indices: jax.Array) -> T:
    """Take one element along each of the leading axes, which stay as axes of length one; indices are clamped.

    Args:
        tree: A pytree; every leaf has at least ``len(start_indices)`` leading axes.
        start_indices: Shape ``(n,)``, int: the index into each of the first ``n`` axes.

    Returns:
        The tree with leaves of shape ``(1,) * n + leaf.shape[n:]``.
    """
    n = start_indices.shape[0]

    def one(leaf: jax.Array) -> jax.Array:
        leaf = jnp.asarray(leaf)
        rest = leaf.ndim - n
        starts = [*start_indices, *[0] * rest]
        return jax.lax.dynamic_slice(leaf, starts, (1,) * n + leaf.shape[n:])

    return jax.tree_util.tree_map(one, tree)
