"""Running statistics of the networks' inputs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sim2real.policy.runner import OBSERVATION_CLIP
from sim2real.types import Array

_MIN_VARIANCE = 1e-6
"""Smallest variance of an observation, in its unit squared."""


class Normaliser(NamedTuple):
    """Running mean and variance of the observations, or of the value function's further inputs.

    Attributes:
        seen: Shape ``()``: number of observations so far.
        mean: Shape ``(O,)``.
        var: Shape ``(O,)``.
    """

    seen: Array
    mean: Array
    var: Array


def update_normaliser(normaliser: Normaliser, observations: jax.Array, valid: jax.Array) -> Normaliser:
    """Return the statistics with more observations added (parallel variance, Chan et al. 1979).

    Args:
        observations: Shape ``(T, N, O)``.
        valid: Shape ``(T, N)``, bool: the observations that count.
    """
    # Mean and variance of the new observations.
    weight = valid.astype(jnp.float32)[..., None]
    count = jnp.maximum(weight.sum(), 1.0)
    mean = (weight * observations).sum((0, 1), keepdims=True) / count
    var = (weight * (observations - mean) ** 2).sum((0, 1)) / count

    # Those of all observations.
    total = normaliser.seen + count
    delta = mean[0, 0] - normaliser.mean
    squares = normaliser.var * normaliser.seen + var * count + delta**2 * normaliser.seen * count / total
    return Normaliser(total, normaliser.mean + delta * count / total, squares / total)


def deviations(normaliser: Normaliser) -> jax.Array:
    """Return the standard deviations that a policy divides by, shape ``(O,)``."""
    return jnp.sqrt(normaliser.var + _MIN_VARIANCE)


def normalise_parameters(normaliser: Normaliser, values: jax.Array) -> jax.Array:
    """Return physical parameters ``(O,)`` in deviations from their mean.

    They have any order of magnitude, and some are equal in all episodes. So the smallest deviation is a thousandth of
    the mean, not a constant.
    """
    std = jnp.sqrt(normaliser.var + (1e-3 * normaliser.mean) ** 2 + 1e-20)
    return jnp.clip((values - normaliser.mean) / std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
