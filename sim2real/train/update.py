"""One PPO update: play rows, estimate advantages, take minibatch steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sim2real.train.config import PPOConfig
from sim2real.train.networks import Policy, apply_mlp, entropy, log_prob
from sim2real.train.protocol import Environment
from sim2real.train.rollout import Copies, Rows, collect


class Normaliser(NamedTuple):
    """Running mean and variance of the observations: ``count`` of shape ``()``, the others ``(O,)``."""

    count: jax.Array
    mean: jax.Array
    var: jax.Array


class TrainState(NamedTuple):
    """Everything that training carries from update to update, for one seed.

    Attributes:
        params: ``{"actor": Layers, "log_std": (A,), "value": Layers}``.
        optimiser: State of the optimiser.
        normaliser: Statistics of the observations so far.
        copies: The environments.
        update: Shape ``()``, int32: updates so far.
        key: The seed's key; it never changes, ``keys`` makes those of an update.
    """

    params: dict[str, Any]
    optimiser: Any
    normaliser: Normaliser
    copies: Copies
    update: jax.Array
    key: jax.Array


class Batch(NamedTuple):
    """Rows prepared for the loss; leading axes ``(N, T)`` or flat.

    Attributes:
        x: Shape ``(..., O)``: normalised observations.
        u: Shape ``(..., A)``: what the policy drew.
        log_prob: Its log density then.
        value: The value then.
        advantage: Shape ``(...)``.
        weight: 1 where a policy step happened, else 0.
    """

    x: jax.Array
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    weight: jax.Array


def make_optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam with gradient clipping and a step size that falls linearly to 5 %.

    Over one flat vector: a dozen small arrays would take longer to compile and to step.
    """
    steps = config.updates * config.epochs * config.minibatches
    rate = optax.linear_schedule(config.learning_rate, 0.05 * config.learning_rate, steps)
    return optax.flatten(optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5)))


def make_policy(env: Environment, params: dict[str, Any], normaliser: Normaliser) -> Policy:
    """Return the policy that the parameters and the statistics so far make."""
    return Policy(
        layers=params["actor"],
        log_std=params["log_std"],
        mean=normaliser.mean,
        std=jnp.sqrt(normaliser.var + 1e-6),
        low=jnp.asarray(env.action_low, jnp.float32),
        high=jnp.asarray(env.action_high, jnp.float32),
    )


def update_normaliser(normaliser: Normaliser, rows: Rows) -> Normaliser:
    """Merge the observations of the valid rows into the statistics (Chan et al. 1979, parallel variance)."""
    weight = rows.valid.astype(jnp.float32)[..., None]
    count = jnp.maximum(weight.sum(), 1.0)
    mean = (weight * rows.observation).sum((0, 1), keepdims=True) / count
    var = (weight * (rows.observation - mean) ** 2).sum((0, 1)) / count
    total = normaliser.count + count
    delta = mean[0, 0] - normaliser.mean
    spread = normaliser.var * normaliser.count + var * count + delta**2 * normaliser.count * count / total
    return Normaliser(total, normaliser.mean + delta * count / total, spread / total)


def gae(rows: Rows, value: jax.Array, following: jax.Array, gamma: float, gae_lambda: float) -> jax.Array:
    """Return generalised advantage estimates (Schulman et al. 2016) that pass through rows without a policy step.

    The reward of an invalid row belongs to the policy step before it, undiscounted; the discount applies once from one
    policy step to the next. An episode's end cuts the sum: after termination nothing follows, after truncation the
    value of the final observation.

    Args:
        rows: T rows of N copies.
        value: Shape ``(T, N)``: value of ``rows.observation``.
        following: Shape ``(T, N)``: value of ``rows.following``.
        gamma: Discount per policy step.
        gae_lambda: Weight of long estimates.

    Returns:
        Shape ``(T, N)``; meaningless in invalid rows.
    """

    def back(
        carry: tuple[jax.Array, jax.Array, jax.Array], x: tuple[Rows, jax.Array, jax.Array]
    ) -> tuple[Any, jax.Array]:
        later_advantage, later_value, later_reward = carry  # of the next policy step, and of invalid rows before it
        row, value, following = x
        end = row.terminated | row.truncated
        later_value = jnp.where(end, jnp.where(row.terminated, 0.0, following), later_value)
        later_advantage = jnp.where(end, 0.0, later_advantage)
        reward = row.reward + jnp.where(end, 0.0, later_reward)
        advantage = reward + gamma * (later_value + gae_lambda * later_advantage) - value
        carry = (
            jnp.where(row.valid, advantage, later_advantage),
            jnp.where(row.valid, value, later_value),
            jnp.where(row.valid, 0.0, reward),
        )
        return carry, advantage

    zeros = jnp.zeros_like(value[0])
    return jax.lax.scan(back, (zeros, following[-1], zeros), (rows, value, following), reverse=True)[1]


def loss(params: dict[str, Any], batch: Batch, config: PPOConfig) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the clipped PPO loss (Schulman et al. 2017) over the valid rows, and its parts; shapes ``()``."""
    weight = batch.weight / jnp.maximum(batch.weight.sum(), 1.0)
    centred = batch.advantage - jnp.sum(weight * batch.advantage)
    advantage = centred / jnp.sqrt(jnp.sum(weight * centred**2) + 1e-8)
    log_ratio = jax.vmap(lambda u, x: log_prob(u, apply_mlp(params["actor"], x), params["log_std"]))(batch.u, batch.x)
    log_ratio = log_ratio - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(advantage * ratio, advantage * clipped))
    moved = jax.vmap(lambda x: apply_mlp(params["value"], x)[0])(batch.x) - batch.value
    held = jnp.clip(moved, -config.value_clip, config.value_clip)
    # The target is value + advantage, so its distance from value + moved is moved - advantage.
    error = jnp.maximum((moved - batch.advantage) ** 2, (held - batch.advantage) ** 2)
    value_loss = 0.5 * jnp.sum(weight * error)
    bonus = entropy(params["log_std"])
    parts = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": bonus,
        "kl": jnp.sum(weight * (ratio - 1.0 - log_ratio)),
        "clip_share": jnp.sum(jnp.where(jnp.abs(ratio - 1.0) > config.clip, weight, 0.0)),
    }
    return policy_loss + config.value_coef * value_loss - config.entropy_coef * bonus, parts


def prepare(params: dict[str, Any], policy: Policy, rows: Rows, config: PPOConfig) -> Batch:
    """Evaluate both networks on all rows at once; returns leading axes ``(N, T)``."""

    def over_rows(function: Callable[..., jax.Array], *leaves: jax.Array) -> jax.Array:
        return jax.vmap(jax.vmap(function))(*leaves)

    x, x_following = over_rows(policy.normalise, rows.observation), over_rows(policy.normalise, rows.following)
    value = over_rows(lambda x: apply_mlp(params["value"], x)[0], x)
    following = over_rows(lambda x: apply_mlp(params["value"], x)[0], x_following)
    batch = Batch(
        x=x,
        u=rows.u,
        log_prob=over_rows(lambda u, x: log_prob(u, apply_mlp(policy.layers, x), policy.log_std), rows.u, x),
        value=value,
        advantage=gae(rows, value, following, config.gamma, config.gae_lambda),
        weight=rows.valid.astype(jnp.float32),
    )
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), batch)


def keys(state: TrainState) -> jax.Array:
    """Return the keys ``(3,)`` of the update that comes next: to play, to shuffle, and to evaluate just before it.

    They depend on the seed and the number of the update alone: how often one evaluates does not change the training.
    """
    return jax.random.split(jax.random.fold_in(state.key, state.update), 3)


def update(env: Environment, config: PPOConfig, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
    """Play one rollout and learn from it.

    Minibatches are drawn by copies, not by rows: shuffling N indices is cheap, and a copy's rows lie side by side.
    The normaliser moves after the networks have, so that the noise's density is the one that the rows were drawn with.

    Returns:
        The next state, and figures of the update: the parts of the loss, mean ``reward`` and ``value`` (unscaled) per
        row, each of shape ``()``, and ``finite_observation``, shape ``(O,)``.
    """
    key_play, key_shuffle, _ = keys(state)
    policy = make_policy(env, state.params, state.normaliser)
    copies, rows = collect(env, config, policy, state.copies, state.update, key_play)
    batch = prepare(state.params, policy, rows, config)
    optimiser = make_optimiser(config)

    def minibatch(carry: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], dict[str, jax.Array]]:
        params, optimiser_state = carry
        part = jax.tree.map(lambda leaf: leaf[index].reshape(-1, *leaf.shape[2:]), batch)
        (total, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params, part, config)
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), parts | {"loss": total}

    shuffles = jax.vmap(lambda k: jax.random.permutation(k, config.num_envs))(
        jax.random.split(key_shuffle, config.epochs)
    )
    index = shuffles.reshape(config.epochs * config.minibatches, -1)
    (params, optimiser_state), parts = jax.lax.scan(minibatch, (state.params, state.optimiser), index)
    stats = jax.tree.map(jnp.mean, parts) | {
        "reward": jnp.mean(rows.reward) / config.reward_scale,
        "value": jnp.sum(batch.weight * batch.value) / jnp.maximum(batch.weight.sum(), 1.0) / config.reward_scale,
        "finite_observation": jnp.isfinite(rows.following).all((0, 1)),
    }
    normaliser = update_normaliser(state.normaliser, rows)
    return TrainState(params, optimiser_state, normaliser, copies, state.update + 1, state.key), stats
