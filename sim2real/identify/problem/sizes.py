"""Sizes of compiled programs: counts are rounded up, so that logs of similar length share programs."""

import numpy as np

from sim2real import pytree
from sim2real.types import PyTree

_EXACT = 4
"""Largest count that is not rounded."""


def rounded(count: int, steps: int = 4) -> int:
    """Return a count rounded up to one of ``steps`` sizes between a power of two and the next.

    Four steps add a quarter at most and an eighth on average; eight steps add half of that.

    Args:
        count: At least 1.
    """
    if count <= max(_EXACT, steps):
        return count
    unit = max(1, 2 ** (int(count - 1).bit_length() - 1) // steps)
    return -(-count // unit) * unit


def padded(tree: PyTree, size: int, axis: int = 0) -> PyTree:
    """Return arrays that repeat their last entry along an axis up to a size.

    Args:
        size: At least the length along the axis.
    """

    def one(leaf: np.ndarray) -> np.ndarray:
        width = [(0, size - leaf.shape[i]) if i == axis else (0, 0) for i in range(leaf.ndim)]
        return np.pad(leaf, width, mode="edge")

    return pytree.map(lambda leaf: one(np.asarray(leaf)), tree)
