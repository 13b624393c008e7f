"""Derivatives of functions that cannot be differentiated, or whose linearisation would remember too much."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def finite_differences(f: Callable[[Any], Any], step: float = 3e-3) -> Callable[[Any], Any]:
    """Return ``f`` with a forward-mode derivative by central differences along the tangent.

    Its Jacobian costs two evaluations a column, as any finite differences do; they run side by side.

    Args:
        f: Array ``(P,)`` -> array; it may call back to Python.
        step: Largest change of an entry; about the cube root of float32's precision, relative to entries near 1.
    """
    wrapped = jax.custom_jvp(f)

    def rule(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        (x,), (t,) = primals, tangents
        size = jnp.maximum(jnp.max(jnp.abs(t)), 1e-30)
        move = t / size * step
        slope = (f(x + move) - f(x - move)) * (size / (2.0 * step))
        return f(x), slope

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
