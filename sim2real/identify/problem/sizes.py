"""Sizes of compiled programs: counts are rounded up, so that logs of about one length share their programs."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

_EXACT = 4
"""Counts up to this one are kept."""


def rounded(count: int, steps: int = 4) -> int:
    """Return a count rounded up to one of ``steps`` sizes between a power of two and the next.

    With four steps at most a quarter is added, an eighth on average; with eight steps half as much.

    Args:
        count: At least 1.
    """
    if count <= max(_EXACT, steps):
        return count
    unit = max(1, 2 ** (int(count - 1).bit_length() - 1) // steps)
    return -(-count // unit) * unit


def padded(tree: Any, size: int, axis: int = 0) -> Any:
    """Return arrays that repeat their last entry along an axis until they have a size.

    Args:
        size: That length or more.
    """

    def one(leaf: np.ndarray) -> np.ndarray:
        width = [(0, size - leaf.shape[i]) if i == axis else (0, 0) for i in range(leaf.ndim)]
        return np.pad(leaf, width, mode="edge")

    return jax.tree_util.tree_map(lambda leaf: one(np.asarray(leaf)), tree)
