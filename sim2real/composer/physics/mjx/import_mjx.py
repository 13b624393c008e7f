"""``mujoco.mjx``, imported silently: without Warp it prints to stdout, which is for data."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx as mjx
    from mujoco.mjx._src import scan  # private: mujoco-mjx is pinned, and a test would show a change

if TYPE_CHECKING:
    from sim2real.types import PyTree

T = TypeVar("T")
_vmap = scan._nvmap
_tracing = threading.RLock()


@contextlib.contextmanager
def held_links() -> Iterator[None]:
    """Let code that is traced in the block end XLA's fusion at each link of a chain of bodies.

    On a CPU, XLA would fuse the whole chain, and compute each link's pose at each use: twice as often with every link.
    Other code that calls MJX is not affected; only one thread at a time traces such a block.
    """
    with _tracing:
        before = scan._nvmap
        scan._nvmap = _held
        try:
            yield
        finally:
            scan._nvmap = before


def _held(f: Callable[..., T], carry: T | None, *args: jax.Array) -> T:
    if carry is not None:
        carry = jax.tree.map(_barrier, carry)
    return _vmap(f, carry, *args)


def _barrier(leaf: PyTree) -> PyTree:
    """Return a leaf behind an optimisation barrier, except types of joints, on which the trace depends."""
    is_static = not isinstance(leaf, jax.Array) or not jnp.issubdtype(leaf.dtype, jnp.inexact)
    return leaf if is_static else jax.lax.optimization_barrier(leaf)
