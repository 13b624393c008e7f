"""Adam, and the schedule of its step size."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sim2real.training.config import PPOConfig

ADAM_EPS = 1e-5
MIN_RATE, MAX_RATE, RATE_FACTOR = 1e-5, 1e-2, 1.5
"""Bounds of an adaptive step size, and the factor of a change: those of rsl_rl."""


def make_optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam with gradient clipping; a linear step size falls to 5 %, an adaptive one is part of the state.

    It acts on one flat vector, which compiles and runs faster than a dozen small arrays.
    """
    if config.schedule == "adaptive":
        adam = optax.inject_hyperparams(optax.adam, static_args=("eps",))(config.learning_rate, eps=ADAM_EPS)
    else:
        steps = config.updates * config.epochs * config.minibatches
        rate = optax.linear_schedule(config.learning_rate, 0.05 * config.learning_rate, steps)
        adam = optax.adam(rate, eps=ADAM_EPS)
    return optax.flatten(optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam))


def get_rate(state: optax.OptState) -> jax.Array:
    """Return the adaptive step size in an optimiser's state."""
    return optax.tree_utils.tree_get(state, "learning_rate")


def set_rate(state: optax.OptState, rate: jax.Array | np.floating) -> optax.OptState:
    """Return an optimiser's state with another adaptive step size."""
    return optax.tree_utils.tree_set(state, learning_rate=rate)


def adapt_rate(rate: jax.Array, kl: jax.Array, target_kl: float) -> jax.Array:
    """Return the next step size: smaller if the policy moved too far, larger if it hardly moved.

    Args:
        rate: Shape ``()``.
        kl: Shape ``()``: KL divergence from the policy that played [nat]; 0, as before the first step, keeps the rate.
        target_kl: Wanted KL divergence [nat].
    """
    smaller, larger = jnp.maximum(rate / RATE_FACTOR, MIN_RATE), jnp.minimum(rate * RATE_FACTOR, MAX_RATE)
    return jnp.where(kl > 2 * target_kl, smaller, jnp.where((kl > 0) & (kl < target_kl / 2), larger, rate))
