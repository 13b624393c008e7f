"""Whether what a step returns looks like what it got: nothing becomes another type on the way unnoticed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError


def matched(node: str, what: str, got: Any, reference: str, like: Any) -> Any:
    """Return ``got`` with the dtypes of ``like``, after ``check_match``: no value changes.

    Args and raises: as ``check_match``.
    """
    check_match(node, what, got, reference, like)

    def cast(new: Any, old: Any) -> Any:
        dtype = jnp.result_type(old)
        return new if new is old or jnp.issubdtype(dtype, jax.dtypes.extended) else jnp.asarray(new, dtype)

    return jax.tree_util.tree_map(cast, got, like)


def check_match(node: str, what: str, got: Any, reference: str, like: Any) -> None:
    """Check that structures, shapes and dtypes are equal.

    Only what JAX itself takes for the same dtype may differ: a Python number becomes what it meets (``0`` a float, but
    ``0.5`` no integer), and a double is a float32 unless 64 bits are enabled.

    Args:
        node: The node's name.
        what: What is checked, in words.
        got: What that is: arrays, or shapes and dtypes.
        reference: What it must look like, in words.
        like: What that is.

    Raises:
        UsageError: When they differ, naming the leaf.
    """
    where = f"node {node!r}: {what} differs from {reference}"
    trees = [jax.tree_util.tree_structure(t) for t in (got, like)]
    if trees[0] != trees[1]:
        raise UsageError(f"{where}: {trees[0]} instead of {trees[1]}", hint="keep to the same fields everywhere")
    flat, _ = jax.tree_util.tree_flatten_with_path(like)
    for new, (path, old) in zip(jax.tree_util.tree_leaves(got), flat, strict=True):
        found, wanted = _describe(new), jnp.result_type(old)
        weak = getattr(found, "weak_type", False) and jnp.result_type(new, wanted) == wanted
        if new is old or (found is not None and np.shape(old) == found.shape and (weak or found.dtype == wanted)):
            continue
        looks = type(new).__name__ if found is None else f"{found.dtype}{list(found.shape)}"
        raise UsageError(
            f"{where}: {jax.tree_util.keystr(path) or 'the value'} is {looks} instead of {wanted}{list(np.shape(old))}",
            hint="keep shapes and dtypes fixed, e.g. jnp.float32(0.0) in init, x.astype(...) in step",
        )


def _describe(leaf: Any) -> Any:
    """Return shape and dtype of a leaf; None if it is no array or number."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf
    try:
        return jax.typeof(leaf)
    except TypeError:
        return None
