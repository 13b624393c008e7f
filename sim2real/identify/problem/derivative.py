"""Derivatives of functions that JAX cannot differentiate, or only with too much memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sim2real.later import jax, jnp
from sim2real.types import PyTree


def finite_differences(f: Callable[[PyTree], PyTree], step: float = 3e-3) -> Callable[[PyTree], PyTree]:
    """Return ``f`` with a forward-mode derivative by central differences along every entry.

    One batched evaluation returns the value and all ``2 P`` neighbours, so a program contains ``f`` once: a rollout of
    MuJoCo takes 20 s to trace and compile.

    Args:
        f: Array ``(P,)`` -> array; it may call back to Python.
        step: Change of an entry; the default is about the cube root of float32's precision, for entries near 1.
    """
    wrapped = jax.custom_jvp(f)

    def rule(primals: tuple[Any], tangents: tuple[Any]) -> tuple[PyTree, PyTree]:
        (x,), (t,) = primals, tangents
        # Evaluate the point and both sides of each entry in one batch.
        n = x.size
        moves = step * jnp.concatenate(
            [jnp.zeros((1, n), x.dtype), jnp.eye(n, dtype=x.dtype), -jnp.eye(n, dtype=x.dtype)]
        )
        values = jax.vmap(f)(x + moves)
        columns = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * step)
        return values[0], jnp.tensordot(t, columns, axes=1)

    wrapped.defjvp(rule)
    return wrapped
