"""Helpers over pytrees whose leaves share leading axes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def tree_dynamic_slice(tree: Any, start_indices: jax.Array) -> Any:
    """Take one element per leading axis, clamped at the ends, keeping those axes with length one.

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


def strong(tree: Any) -> Any:
    """Give every leaf a strong dtype, so that a scan's carry keeps its type."""
    return jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(leaf)), tree)
