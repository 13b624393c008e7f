"""One PPO update: a rollout, advantage estimates, and minibatch steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sim2real.train.config import PPOConfig
from sim2real.train.mesh import spread
from sim2real.train.networks import Policy, apply_mlp, entropy, log_prob
from sim2real.train.normaliser import Normaliser, normalise_parameters, update_normaliser
from sim2real.train.optimiser import adapt_rate, get_rate, make_optimiser, set_rate
from sim2real.train.protocol import TrainingEnvironment
from sim2real.train.rollout import Copies, Rows, collect


class TrainState(NamedTuple):
    """Everything that training carries from update to update, for one seed.

    Attributes:
        params: ``{"actor": Layers, "log_std": (A,), "value": Layers}``.
        optimiser: State of the optimiser.
        normaliser: Statistics of the observations so far.
        privileged: Statistics of what the value function sees besides; None: it sees the observation alone.
        copies: The environments.
        update: Shape ``()``, int32: number of updates so far.
        key: The seed's key; it never changes. ``keys`` derives the keys of an update from it.
    """

    params: dict[str, Any]
    optimiser: optax.OptState
    normaliser: Normaliser
    privileged: Normaliser | None
    copies: Copies
    update: jax.Array
    key: jax.Array


_Learnt = tuple[Any, optax.OptState]
"""Parameters, and the state of the optimiser."""


class Batch(NamedTuple):
    """Rows prepared for the loss; leading axes ``(N, T)`` or flat.

    Attributes:
        x: Shape ``(..., O)``: normalised observations.
        critic: Shape ``(..., O + P)``: what the value function is given; None: it is ``x``.
        u: Shape ``(..., A)``: the policy's samples.
        log_prob: Shape ``(...)``: log density of ``u`` under the policy that drew it.
        value: Shape ``(...)``: value estimates before the update.
        advantage: Shape ``(...)``.
        weight: Shape ``(...)``: 1 in rows with a policy step, else 0.
    """

    x: jax.Array
    critic: jax.Array | None
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    weight: jax.Array


def make_policy(env: TrainingEnvironment, params: dict[str, Any], normaliser: Normaliser) -> Policy:
    """Return the policy with the given parameters and normaliser.

    Args:
        env: Gives the action bounds.
        params: As in ``TrainState``.
        normaliser: Statistics of the observations.
    """
    return Policy(
        layers=params["actor"],
        log_std=params["log_std"],
        mean=normaliser.mean,
        std=jnp.sqrt(normaliser.var + 1e-6),
        low=jnp.asarray(env.action_low, jnp.float32),
        high=jnp.asarray(env.action_high, jnp.float32),
    )


def gae(rows: Rows, value: jax.Array, following: jax.Array, gamma: float, gae_lambda: float) -> jax.Array:
    """Return generalised advantage estimates (Schulman et al. 2016) of rows, some of which have no policy step.

    The reward of a row without a policy step is added, undiscounted, to the reward of the policy step before it; the
    discount applies once per policy step. At an episode's end the sum stops; after truncation the value of the final
    observation is added.

    Args:
        rows: T rows of N copies.
        value: Shape ``(T, N)``: value of ``rows.observation``.
        following: Shape ``(T, N)``: value of ``rows.following``.
        gamma: Discount per policy step.
        gae_lambda: Lambda of the estimator, 0 to 1.

    Returns:
        Shape ``(T, N)``; meaningless in rows without a policy step.
    """

    def back(
        carry: tuple[jax.Array, jax.Array, jax.Array], x: tuple[Rows, jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
        later_advantage, later_value, later_reward = carry  # of the next policy step, and of the rows before it
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
    """Return the clipped PPO loss (Schulman et al. 2017) over the valid rows.

    Args:
        params: As in ``TrainState``.
        batch: The rows, with one leading axis.
        config: Clip ranges and weights.

    Returns:
        The loss, and its parts by name; each of shape ``()``.
    """
    weight = batch.weight / jnp.maximum(batch.weight.sum(), 1.0)
    centred = batch.advantage - jnp.sum(weight * batch.advantage)
    advantage = centred / jnp.sqrt(jnp.sum(weight * centred**2) + 1e-8)
    log_ratio = jax.vmap(lambda u, x: log_prob(u, apply_mlp(params["actor"], x), params["log_std"]))(batch.u, batch.x)
    log_ratio = log_ratio - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(advantage * ratio, advantage * clipped))
    critic = batch.x if batch.critic is None else batch.critic
    moved = jax.vmap(lambda x: apply_mlp(params["value"], x)[0])(critic) - batch.value
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


def prepare(state: TrainState, policy: Policy, rows: Rows, config: PPOConfig) -> Batch:
    """Return the batch of a rollout: normalised observations, values, log densities and advantages.

    Args:
        state: Its value network and normalisers are used.
        policy: The policy that played the rows.
        rows: T rows of N copies.
        config: Discount and lambda.

    Returns:
        The batch with leading axes ``(N, T)``.
    """

    def over_rows(function: Callable[..., jax.Array], *leaves: jax.Array) -> jax.Array:
        return jax.vmap(jax.vmap(function))(*leaves)

    def judged(x: jax.Array, privileged: jax.Array | None) -> jax.Array:
        """Return what the value function is given."""
        if privileged is None or state.privileged is None:
            return x
        known = over_rows(partial(normalise_parameters, state.privileged), privileged)
        return jnp.concatenate([x, known], axis=-1)

    x, x_following = over_rows(policy.normalise, rows.observation), over_rows(policy.normalise, rows.following)
    critic, critic_following = judged(x, rows.privileged), judged(x_following, rows.privileged_following)
    value = over_rows(lambda x: apply_mlp(state.params["value"], x)[0], critic)
    following = over_rows(lambda x: apply_mlp(state.params["value"], x)[0], critic_following)
    batch = Batch(
        x=x,
        critic=None if state.privileged is None else critic,
        u=rows.u,
        log_prob=over_rows(lambda u, x: log_prob(u, apply_mlp(policy.layers, x), policy.log_std), rows.u, x),
        value=value,
        advantage=gae(rows, value, following, config.gamma, config.gae_lambda),
        weight=rows.valid.astype(jnp.float32),
    )
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), batch)


def keys(state: TrainState) -> jax.Array:
    """Return three keys of the next update: for its rollout, for its shuffles, and for an evaluation before it.

    They depend on the seed and the number of the update alone, so the number of evaluations does not affect training.
    """
    return jax.random.split(jax.random.fold_in(state.key, state.update), 3)


def update(env: TrainingEnvironment, config: PPOConfig, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
    """Play one rollout and update the networks and the normaliser.

    Each minibatch has all rows of some of the copies: shuffling N indices is cheap, and a copy's rows are adjacent in
    memory. The normaliser is updated after the networks: log densities are those of the policy that played the rows.

    Args:
        env: The environment.
        config: Settings.
        state: The state before.

    Returns:
        The next state, and figures of the update: the parts of the loss and the mean ``reward`` and ``value`` per row,
        unscaled, each of shape ``()``; ``finite_observation``, shape ``(O,)``, bool; and ``finite_privileged``, shape
        ``(P,)``, bool, where the value function sees more.
    """
    key_play, key_shuffle, _ = keys(state)
    policy = make_policy(env, state.params, state.normaliser)
    copies, rows = collect(env, config, policy, state.copies, state.update, key_play)
    batch = prepare(state, policy, rows, config)
    optimiser = make_optimiser(config)

    def minibatch(carry: _Learnt, part: Batch) -> tuple[_Learnt, dict[str, jax.Array]]:
        params, optimiser_state = carry
        part = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), part)
        (total, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params, part, config)
        if config.schedule == "adaptive":
            rate = adapt_rate(get_rate(optimiser_state), parts["kl"], config.target_kl)
            optimiser_state, parts = set_rate(optimiser_state, rate), parts | {"learning_rate": rate}
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), parts | {"loss": total}

    def epoch(carry: _Learnt, shuffle: jax.Array) -> tuple[_Learnt, dict[str, jax.Array]]:
        # Shuffled once, not in each minibatch: devices exchange copies here alone, then gradients.
        index = shuffle.reshape(config.minibatches, -1)
        return jax.lax.scan(minibatch, carry, spread(jax.tree.map(lambda leaf: leaf[index], batch), config))

    shuffles = jax.vmap(lambda k: jax.random.permutation(k, config.num_envs))(
        jax.random.split(key_shuffle, config.epochs)
    )
    (params, optimiser_state), parts = jax.lax.scan(epoch, (state.params, state.optimiser), shuffles)
    stats = jax.tree.map(jnp.mean, parts) | {
        "reward": jnp.mean(rows.reward) / config.reward_scale,
        "value": jnp.sum(batch.weight * batch.value) / jnp.maximum(batch.weight.sum(), 1.0) / config.reward_scale,
        "finite_observation": jnp.isfinite(rows.following).all((0, 1)),
    }
    if rows.privileged_following is not None:
        stats |= {"finite_privileged": jnp.isfinite(rows.privileged_following).all((0, 1))}
    normaliser, privileged = update_normaliser(state.normaliser, rows.observation, rows.valid), None
    if state.privileged is not None and rows.privileged is not None:
        privileged = update_normaliser(state.privileged, rows.privileged, rows.valid)
    return TrainState(params, optimiser_state, normaliser, privileged, copies, state.update + 1, state.key), stats
