"""One PPO update: makes the batch of a rollout with advantages, takes minibatch steps, updates the normaliser."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sim2real.policy.contract import NetworkSpec
from sim2real.policy.runner import OBSERVATION_CLIP
from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import TrainingEnvironment, widen
from sim2real.training.networks.policy import Policy, log_prob
from sim2real.training.ppo.losses import ActorCritic, Batch, gae, loss, unroll
from sim2real.training.ppo.rollout import Copies, Rows
from sim2real.training.scale.devices import divide_minibatches
from sim2real.types import Array, PyTree

_MIN_VARIANCE = 1e-6
"""Smallest variance of an observation, in its unit squared."""
ADAM_EPS = 1e-5
MIN_RATE, MAX_RATE, RATE_FACTOR = 1e-5, 1e-2, 1.5
"""Bounds of an adaptive step size, and the factor of a change, as in rsl_rl."""


# -- running statistics of the networks' inputs


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

    # Combine them with all earlier observations.
    total = normaliser.seen + count
    delta = mean[0, 0] - normaliser.mean
    squares = normaliser.var * normaliser.seen + var * count + delta**2 * normaliser.seen * count / total
    return Normaliser(total, normaliser.mean + delta * count / total, squares / total)


def deviations(normaliser: Normaliser) -> jax.Array:
    """Return the standard deviations that a policy divides by, shape ``(O,)``."""
    return jnp.sqrt(normaliser.var + _MIN_VARIANCE)


def normalise_parameters(normaliser: Normaliser, values: jax.Array) -> jax.Array:
    """Return physical parameters ``(O,)`` minus their means, in standard deviations.

    Their orders of magnitude differ, and some are equal in all episodes. So the smallest standard deviation is a
    thousandth of the mean, and not a constant.
    """
    std = jnp.sqrt(normaliser.var + (1e-3 * normaliser.mean) ** 2 + 1e-20)
    return jnp.clip((values - normaliser.mean) / std, -OBSERVATION_CLIP, OBSERVATION_CLIP)


# -- Adam, and the schedule of its step size


def make_optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam with gradient clipping; a linear step size falls to 5 %, an adaptive one is part of the state.

    Adam acts on one flat vector, which compiles and runs faster than a dozen small arrays.
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
        kl: Shape ``()``: KL divergence from the policy that played [nat]; 0 (before the first step) keeps the rate.
        target_kl: Wanted KL divergence [nat].
    """
    smaller, larger = jnp.maximum(rate / RATE_FACTOR, MIN_RATE), jnp.minimum(rate * RATE_FACTOR, MAX_RATE)
    return jnp.where(kl > 2 * target_kl, smaller, jnp.where((kl > 0) & (kl < target_kl / 2), larger, rate))


# -- the update


class TrainState(NamedTuple):
    """The state of one seed's training between two updates.

    Attributes:
        params: ``{"actor": ..., "log_std": (A,), "value": ...}``: the networks' parameters, and the log standard
            deviation of the noise.
        privileged: Statistics of the value function's further inputs; None if it has none.
        update: Shape ``()``, int32: number of updates so far.
        key: The seed's key; it never changes. ``keys`` derives the keys of an update from it.
        reached: Shape ``()``: the share of a curriculum that follows success; None without such a curriculum.
    """

    params: dict[str, PyTree]
    optimiser: optax.OptState
    normaliser: Normaliser
    privileged: Normaliser | None
    copies: Copies
    update: jax.Array
    key: jax.Array
    reached: jax.Array | None = None


_Learner = tuple[PyTree, optax.OptState]
"""Parameters, and the state of the optimiser."""


def make_policy(
    env: TrainingEnvironment,
    config: PPOConfig,
    networks: ActorCritic,
    params: dict[str, PyTree],
    normaliser: Normaliser,
) -> Policy:
    """Return the policy with parameters as in ``TrainState``."""
    return Policy(
        params=params["actor"],
        log_std=params["log_std"],
        mean=jnp.asarray(normaliser.mean),
        std=deviations(normaliser),
        low=jnp.asarray(env.action_low, jnp.float32),
        high=jnp.asarray(env.action_high, jnp.float32),
        network=networks.actor,
        spec=NetworkSpec(networks.name, config.squash),
    )


def prepare(
    state: TrainState, policy: Policy, rows: Rows, config: PPOConfig, networks: ActorCritic
) -> tuple[Batch, PyTree]:
    """Return the batch of a rollout: normalised observations, values, log densities and advantages.

    Returns:
        The batch, and the value function's carry after the last row.
    """
    # Normalise the inputs of both networks, in each row and after it.
    x, x_following = _over_rows(policy.normalise, rows.observation), _over_rows(policy.normalise, rows.following)
    critic = _critic_input(state, x, rows.privileged)
    critic_following = _critic_input(state, x_following, rows.privileged_following)

    # Compute the means of the actions, and the values; the networks may have memory.
    end, copies, squash = rows.terminated | rows.truncated, state.copies, policy.spec.squash
    mean = unroll(networks.actor, policy.params, copies.carry, x, rows.valid, end).y
    values = unroll(
        networks.critic, state.params["value"], copies.critic_carry, critic, rows.valid, end, critic_following
    )
    value, following = values.y[..., 0], jnp.asarray(values.following)[..., 0]

    # The rollout has rows first, minibatches have copies first.
    batch = Batch(
        x=x,
        critic=None if state.privileged is None else critic,
        u=rows.u,
        log_prob=_over_rows(lambda u, mean: log_prob(u, mean, policy.log_std, squash), rows.u, mean),
        value=value,
        advantage=gae(rows, value, following, config.gamma, config.gae_lambda),
        weight=rows.valid.astype(jnp.float32),
        noise=(rows.u - mean) * jnp.exp(-policy.log_std) if squash else None,
        end=end,
        actor_carry=(),
        critic_carry=(),
    )
    batch = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), batch)
    return batch._replace(actor_carry=copies.carry, critic_carry=copies.critic_carry), values.carry


def _over_rows(function: Callable[..., jax.Array], *leaves: jax.Array) -> jax.Array:
    """Apply a function of one row of one copy to leaves ``(T, N, ...)``."""
    return jax.vmap(jax.vmap(function))(*leaves)


def _critic_input(state: TrainState, x: jax.Array, privileged: jax.Array | None) -> jax.Array:
    """Return the value function's input ``(T, N, O + P)`` from normalised observations ``(T, N, O)``."""
    if privileged is None or state.privileged is None:
        return x
    normalised = _over_rows(partial(normalise_parameters, state.privileged), privileged)
    return jnp.concatenate([x, normalised], axis=-1)


def keys(state: TrainState) -> jax.Array:
    """Return three keys of the next update: for its rollout, for its shuffles, and for an evaluation before it.

    They depend only on the seed and the number of the update, so the number of evaluations does not affect training.
    """
    return jax.random.split(jax.random.fold_in(state.key, state.update), 3)


def update(
    env: TrainingEnvironment, config: PPOConfig, networks: ActorCritic, state: TrainState, copies: Copies, rows: Rows
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Update the networks and the normaliser after a rollout.

    Returns:
        The next state, and figures of the update: the parts of the loss and the mean ``reward`` and ``value`` per row,
        unscaled, each of shape ``()``; ``finite_observation``, shape ``(O,)``, bool; and ``finite_privileged``, shape
        ``(P,)``, bool, if the value function has further inputs.
    """
    # Compute values, log densities and advantages of all rows, before any network changes.
    policy = make_policy(env, config, networks, state.params, state.normaliser)
    batch, critic_carry = prepare(state, policy, rows, config, networks)
    copies = copies._replace(critic_carry=critic_carry)
    optimiser = make_optimiser(config)

    def minibatch(carry: _Learner, part: Batch) -> tuple[_Learner, dict[str, jax.Array]]:
        params, optimiser_state = carry
        (total, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params, part, config, networks)
        if config.schedule == "adaptive":
            rate = adapt_rate(get_rate(optimiser_state), parts["kl"], config.target_kl)
            optimiser_state, parts = set_rate(optimiser_state, rate), parts | {"learning_rate": rate}
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), parts | {"loss": total}

    def epoch(carry: _Learner, shuffle: jax.Array) -> tuple[_Learner, dict[str, jax.Array]]:
        # Shuffle once per epoch, not per minibatch: devices exchange copies only here, and then gradients.
        index = shuffle.reshape(config.minibatches, -1)
        parts = divide_minibatches(jax.tree.map(lambda leaf: leaf[index], batch), config)
        return jax.lax.scan(minibatch, carry, parts)

    # Each minibatch has all rows of some copies: shuffling N indices is cheap, a copy's rows are adjacent in memory,
    # and networks with memory need them in their order.
    shuffles = jax.vmap(lambda k: jax.random.permutation(k, config.num_envs))(
        jax.random.split(keys(state)[1], config.epochs)
    )
    (params, optimiser_state), parts = jax.lax.scan(epoch, (state.params, state.optimiser), shuffles)

    # Average the figures, and note which entries of the observations were finite.
    stats = jax.tree.map(jnp.mean, parts) | {
        "reward": jnp.mean(rows.reward) / config.reward_scale,
        "value": jnp.sum(batch.weight * batch.value) / jnp.maximum(batch.weight.sum(), 1.0) / config.reward_scale,
        "finite_observation": jnp.isfinite(rows.following).all((0, 1)),
    }
    if rows.privileged_following is not None:
        stats |= {"finite_privileged": jnp.isfinite(rows.privileged_following).all((0, 1))}

    # Update the normaliser last: the log densities above belong to the policy that played the rows.
    after = TrainState(params, optimiser_state, *_normalisers(state, rows), copies, state.update + 1, state.key)
    if state.reached is None:
        return after, stats
    ended = rows.terminated | rows.truncated
    return after._replace(reached=widen(env, config, state.reached, rows.metrics["success"], ended)), stats


def _normalisers(state: TrainState, rows: Rows) -> tuple[Normaliser, Normaliser | None]:
    normaliser = update_normaliser(state.normaliser, rows.observation, rows.valid)
    if state.privileged is None or rows.privileged is None:
        return normaliser, None
    return normaliser, update_normaliser(state.privileged, rows.privileged, rows.valid)
