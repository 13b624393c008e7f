"""Derivatives of functions that cannot be differentiated, or whose linearisation would remember too much."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def finite_differences(f: Callable[[Any], Any], step: float = 3e-3) -> Callable[[Any], Any]:
    """Return ``f`` with a forward-mode derivative by central differences along every entry.

    The value and all ``2 P`` neighbours come from one batched evaluation: a rollout of MuJoCo takes 20 s to trace and
    compile, and so it is in a program once, not three times.

    Args:
        f: Array ``(P,)`` -> array; it may call back to Python.
        step: Change of an entry; about the cube root of float32's precision, relative to entries near 1.
    """
    wrapped = jax.custom_jvp(f)

    def rule(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        (x,), (t,) = primals, tangents
        n = x.size
        moves = step * jnp.concatenate(
            [jnp.zeros((1, n), x.dtype), jnp.eye(n, dtype=x.dtype), -jnp.eye(n, dtype=x.dtype)]
        )
        values = jax.vmap(f)(x + moves)
        columns = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * step)
        return values[0], jnp.tensordot(t, columns, axes=1)

    wrapped.defjvp(rule)
    return wrapped


def by_jacobian(f: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return ``f``, array ``(P,)`` -> ``(N,)``, whose derivative is its Jacobian, computed forward and kept.

    ``jax.linearize``, with which optimistix differentiates, would keep every intermediate of a rollout instead.
    """
    wrapped = jax.custom_jvp(f)

    def rule(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        (x,), (t,) = primals, tangents
        value, columns = jax.vmap(lambda d: jax.jvp(f, (x,), (d,)), out_axes=(None, 0))(jnp.eye(x.size, dtype=x.dtype))
        return value, t @ columns

    wrapped.defjvp(rule)
    return wrapped
