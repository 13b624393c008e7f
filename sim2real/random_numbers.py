"""The random numbers that a robot's computer draws, such as targets: JAX's, or the same ones in numpy without JAX."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sim2real.installation import has_jax
from sim2real.later import jax, jnp
from sim2real.types import Array, Key, PyTree

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)


class PlainKey(NamedTuple):
    """A key of random numbers without JAX."""

    seed: int


def key_of(seed: int) -> Key:
    """Return the key of a seed from 0 to 2^31 - 1: JAX's if it is installed, else a ``PlainKey``."""
    plain: PyTree = PlainKey(seed)
    return jax.random.key(seed) if has_jax() else plain


def uniform(key: Key, low: ArrayLike, high: ArrayLike) -> Array:
    """Return one number between each pair of bounds, float32; one key always gives the same ones.

    Args:
        low: Shape ``(n,)``.
        high: Shape ``(n,)``.
    """
    if isinstance(key, PlainKey):
        low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        # The 23 bits of a float32 in [1, 2).
        share = (_bits(key.seed, low.size) >> 9 | np.uint32(0x3F800000)).view(np.float32) - np.float32(1.0)
        return np.maximum(low, share * (high - low) + low)
    low, high = (jnp.asarray(bound, jnp.float32) for bound in (low, high))
    return jax.random.uniform(key, low.shape, minval=low, maxval=high)


def _bits(seed: int, count: int) -> np.ndarray:
    """Return JAX's random bits ``(count,)``, uint32: Threefry-2x32 of the key (0, seed), for the counters from 0 on."""
    keys = np.uint32(0), np.uint32(seed), np.uint32(seed) ^ _PARITY
    with np.errstate(over="ignore"):
        a, b = np.full(count, keys[0]), np.arange(count, dtype=np.uint32) + keys[1]
        for turn in range(5):
            for bits in _ROTATIONS[turn % 2]:
                a = a + b
                b = (b << np.uint32(bits) | b >> np.uint32(32 - bits)) ^ a
            a, b = a + keys[(turn + 1) % 3], b + keys[(turn + 2) % 3] + np.uint32(turn + 1)
    return a ^ b
