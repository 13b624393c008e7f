"""Robust losses: a few large residuals do not decide the fit."""

from __future__ import annotations

from typing import Any

from sim2real.identify.config import Loss
from sim2real.later import jnp
from sim2real.types import Array, PyTree


def tamed(residual: Array, loss: Loss, reach: float, xp: Any = jnp) -> PyTree:
    """Return a residual whose half square is the robust loss of the given one, so that least squares minimises it.

    ``huber`` is the pseudo-Huber loss: squared below ``reach``, linear far above it. ``cauchy`` grows
    with the logarithm.

    Args:
        residual: Array shape, in deviations.
        reach: Above this the loss grows more slowly than the square, in deviations.
    """
    if loss == "squared":
        return residual
    if loss == "huber":  # by hypot: a square may overflow to infinity, which would make the residual 0
        return residual * xp.sqrt(2.0 / (xp.hypot(1.0, residual / reach) + 1.0))
    square = (residual / reach) ** 2
    small = square < 1e-6
    safe = xp.where(small, 1.0, square)  # log(1 + s) / s, without dividing by zero on the branch not taken
    return residual * xp.sqrt(xp.where(small, 1.0 - square / 2.0, xp.log1p(safe) / safe))
