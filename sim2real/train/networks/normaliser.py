"""Running statistics of what networks are given."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sim2real.policy.runner import OBSERVATION_CLIP

_LEAST_VARIANCE = 1e-6
"""Of an observation, in its unit squared."""


class Normaliser(NamedTuple):
    """Running mean and variance of the observations, or of what the value function sees besides.

    Attributes:
        seen: Shape ``()``: number of observations so far.
        mean: Shape ``(O,)``.
        var: Shape ``(O,)``.
    """

    seen: jax.Array
    mean: jax.Array
    var: jax.Array


def update_normaliser(normaliser: Normaliser, seen: jax.Array, valid: jax.Array) -> Normaliser:
    """Return the statistics with more observations added (parallel variance, Chan et al. 1979).

    Args:
        seen: Shape ``(T, N, O)``.
        valid: Shape ``(T, N)``, bool: which of them count.
    """
    weight = valid.astype(jnp.float32)[..., None]
    count = jnp.maximum(weight.sum(), 1.0)
    mean = (weight * seen).sum((0, 1), keepdims=True) / count
    var = (weight * (seen - mean) ** 2).sum((0, 1)) / count
    total = normaliser.seen + count
    delta = mean[0, 0] - normaliser.mean
    spread = normaliser.var * normaliser.seen + var * count + delta**2 * normaliser.seen * count / total
    return Normaliser(total, normaliser.mean + delta * count / total, spread / total)


def deviations(normaliser: Normaliser, privileged: int) -> jax.Array:
    """Return the standard deviations that a policy divides by, shape ``(O,)``.

    Args:
        privileged: How many entries at the end are physical parameters; see ``normalise_parameters``.
    """
    if not privileged:
        return jnp.sqrt(normaliser.var + _LEAST_VARIANCE)
    of_parameters = jnp.arange(normaliser.var.shape[0]) >= normaliser.var.shape[0] - privileged
    return jnp.sqrt(normaliser.var + jnp.where(of_parameters, _least(normaliser), _LEAST_VARIANCE))


def normalise_parameters(normaliser: Normaliser, seen: jax.Array) -> jax.Array:
    """Return ``seen``, shape ``(O,)``, in deviations from its mean.

    Physical parameters are of any size, and some are the same in all episodes: a deviation counts from a thousandth of
    the mean on.
    """
    std = jnp.sqrt(normaliser.var + _least(normaliser))
    return jnp.clip((seen - normaliser.mean) / std, -OBSERVATION_CLIP, OBSERVATION_CLIP)


def _least(normaliser: Normaliser) -> jax.Array:
    """Return the least variance of physical parameters, shape ``(O,)``."""
    return (1e-3 * normaliser.mean) ** 2 + 1e-20
