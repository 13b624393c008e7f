"""Checks that trees have equal structure, shapes and dtypes, e.g. a step's state before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sim2real.errors import UsageError
from sim2real.installation import has_jax
from sim2real.later import jax, jnp

if TYPE_CHECKING:
    from jax.core import ShapedArray
    from jax.typing import ArrayLike


T = TypeVar("T")


def matched(node: str, what: str, got: T, reference: str, like: object) -> T:
    """Return ``got`` with exactly the dtypes of ``like``, after ``check_match``, whose arguments it takes."""
    if not has_jax():
        return got
    check_match(node, what, got, reference, like)

    def cast(new: ArrayLike, old: ArrayLike) -> ArrayLike:
        dtype = jnp.result_type(old)
        return new if new is old or jnp.issubdtype(dtype, jax.dtypes.extended) else jnp.asarray(new, dtype)

    return jax.tree_util.tree_map(cast, got, like)


def check_match(node: str, what: str, got: object, reference: str, like: object) -> None:
    """Check that two trees have equal structures, shapes and dtypes.

    Dtypes may differ where JAX converts without loss: a Python number takes the dtype of ``like`` (``0`` may become a
    float, ``0.5`` not an integer), and float64 counts as float32 unless 64 bits are enabled.

    Raises:
        UsageError: They differ; the message names the first leaf that does.
    """
    # Structure first, then leaf by leaf.
    where = f"node {node!r}: {what} differs from {reference}"
    trees = [jax.tree_util.tree_structure(t) for t in (got, like)]
    if trees[0] != trees[1]:
        raise UsageError(f"{where}: {trees[0]} instead of {trees[1]}", hint="keep to the same fields everywhere")
    flat, _ = jax.tree_util.tree_flatten_with_path(like)
    for new, (path, old) in zip(jax.tree_util.tree_leaves(got), flat, strict=True):
        kind, wanted = _describe(new), jnp.result_type(old)
        weak = getattr(kind, "weak_type", False) and jnp.result_type(new, wanted) == wanted
        if new is old or (kind is not None and np.shape(old) == kind.shape and (weak or kind.dtype == wanted)):
            continue
        text = type(new).__name__ if kind is None else f"{kind.dtype}{list(kind.shape)}"
        raise UsageError(
            f"{where}: {jax.tree_util.keystr(path) or 'the value'} is {text} instead of {wanted}{list(np.shape(old))}",
            hint="keep shapes and dtypes fixed, e.g. jnp.float32(0.0) in init, x.astype(...) in step",
        )


def _describe(leaf: object) -> jax.ShapeDtypeStruct | ShapedArray | None:
    """Return shape and dtype of a leaf; None if it is neither an array nor a number."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf
    try:
        kind = jax.typeof(leaf)
    except TypeError:
        return None
    return kind if hasattr(kind, "weak_type") else None
