"""Whether what a step returns looks like what it got: nothing becomes another type on the way unnoticed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError


def matched(node: str, what: str, got: Any, reference: str, like: Any) -> Any:
    """Return ``got`` with the dtypes of ``like``, after checking that this changes no value.

    Structures, shapes and dtypes must be equal. Only what JAX itself takes for the same may differ: a Python number
    becomes what it meets (``0`` a float, but ``0.5`` no integer), and a double is a float32 unless 64 bits are enabled.

    Args:
        node: The node's name.
        what: What its step returned, in words.
        got: What that is.
        reference: What it must look like, in words.
        like: What that is.

    Raises:
        UsageError: When they differ, naming the leaf.
    """
    where = f"node {node!r}: {what} differs from {reference}"
    trees = [jax.tree_util.tree_structure(t) for t in (got, like)]
    if trees[0] != trees[1]:
        raise UsageError(
            f"{where}: {trees[0]} instead of {trees[1]}", hint="return the same fields from step and from init"
        )
    flat, tree = jax.tree_util.tree_flatten_with_path(like)
    leaves = jax.tree_util.tree_leaves(got)
    return jax.tree_util.tree_unflatten(
        tree, [_leaf(where, path, new, old) for new, (path, old) in zip(leaves, flat, strict=True)]
    )


def _leaf(where: str, path: Any, new: Any, old: Any) -> Any:
    if new is old:
        return old
    wanted = jnp.result_type(old)
    try:
        kind = jax.typeof(new)
    except TypeError:
        found = type(new).__name__
    else:
        fits = kind.dtype == wanted or (kind.weak_type and jnp.result_type(new, wanted) == wanted)
        if fits and kind.shape == np.shape(old):
            return new if jnp.issubdtype(wanted, jax.dtypes.extended) else jnp.asarray(new, wanted)
        found = f"{kind.dtype}{list(kind.shape)}"
    raise UsageError(
        f"{where}: {jax.tree_util.keystr(path) or 'the value'} is {found} instead of {wanted}{list(np.shape(old))}",
        hint="keep shapes and dtypes fixed, e.g. jnp.float32(0.0) in init, x.astype(...) in step",
    )
