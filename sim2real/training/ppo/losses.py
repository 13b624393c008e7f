"""Applies networks to the rows of a rollout, and computes advantages and the loss."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import select
from sim2real.training.networks.architectures import Network, is_recurrent
from sim2real.training.networks.policy import entropy, log_prob, log_slope
from sim2real.training.ppo.rollout import Rows, repeat
from sim2real.types import PyTree


class ActorCritic(NamedTuple):
    """The networks of a training.

    Attributes:
        actor: Computes the mean of the actions.
        critic: Computes the value.
        name: The actor's name in a bundle.
    """

    actor: Network
    critic: Network
    name: str


class Unrolled(NamedTuple):
    """The outputs of a network for T rows of N copies.

    Attributes:
        carry: The carry after the last row; leaves of shape ``(N, ...)``.
        y: Shape ``(T, N, outputs)``.
        following: Shape ``(T, N, outputs)``: outputs for the inputs after each row; None without such inputs.
    """

    carry: PyTree
    y: jax.Array
    following: jax.Array | None


def unroll(
    network: Network,
    params: PyTree,
    carry: PyTree,
    x: jax.Array,
    stepped: jax.Array,
    end: jax.Array,
    following: jax.Array | None = None,
) -> Unrolled:
    """Apply a network to rows; after an episode's end it restarts with the initial carry.

    Args:
        carry: The carry before the first row; leaves of shape ``(N, ...)``.
        x: Shape ``(T, N, inputs)``.
        stepped: Shape ``(T, N)``, bool: rows with a policy step.
        end: Shape ``(T, N)``, bool: rows that end an episode.
        following: Shape ``(T, N, inputs)``: the input after each row, before any reset.
    """
    apply = partial(network.apply, params)
    if not is_recurrent(network):
        # Without memory, all rows are independent.
        rows = jax.vmap(jax.vmap(lambda x: apply(network.initial_carry(), x)[1]))
        return Unrolled(carry, rows(x), None if following is None else rows(following))
    # With memory, scan over the rows.
    start = repeat(network.initial_carry(), x.shape[1])

    def row(
        carry: PyTree, now: tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]
    ) -> tuple[PyTree, tuple[jax.Array, jax.Array | None]]:
        x, stepped, end, following = now
        # A row without a policy step leaves the carry unchanged, the end of an episode resets it.
        new, y = jax.vmap(apply)(carry, x)
        new = select(stepped, new, carry)
        after = None if following is None else jax.vmap(apply)(new, following)[1]
        return select(end, start, new), (y, after)

    carry, (y, after) = jax.lax.scan(row, carry, (x, stepped, end, following))
    return Unrolled(carry, y, after)


class Batch(NamedTuple):
    """T rows of each of N copies: the input of the loss.

    Attributes:
        x: Shape ``(N, T, O)``: normalised observations.
        critic: Shape ``(N, T, O + P)``: the value function's input; None if it is ``x``.
        u: Shape ``(N, T, A)``: the policy's samples.
        log_prob: Shape ``(N, T)``: log density of ``u`` under the policy that drew it.
        value: Shape ``(N, T)``: value estimates before the update.
        advantage: Shape ``(N, T)``.
        weight: Shape ``(N, T)``: 1 in rows with a policy step, else 0.
        noise: Shape ``(N, T, A)``: ``u`` minus its mean, in standard deviations; None if actions are not squashed.
        end: Shape ``(N, T)``, bool: rows that end an episode.
        actor_carry: The actor's carry before the first row; leaves of shape ``(N, ...)``.
        critic_carry: The value function's carry before the first row.
    """

    x: jax.Array
    critic: jax.Array | None
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    weight: jax.Array
    noise: jax.Array | None
    end: jax.Array
    actor_carry: PyTree
    critic_carry: PyTree


def gae(rows: Rows, value: jax.Array, following: jax.Array, gamma: float, gae_lambda: float) -> jax.Array:
    """Return generalised advantage estimates (Schulman et al. 2016), shape ``(T, N)``.

    The reward of a row without a policy step is added, undiscounted, to the reward of the policy step before it; the
    discount applies once per policy step. The estimate of a row without a policy step has no meaning.

    Args:
        value: Shape ``(T, N)``: value of ``rows.observation``.
        following: Shape ``(T, N)``: value of ``rows.following``.
    """

    def back(
        carry: tuple[jax.Array, jax.Array, jax.Array], x: tuple[Rows, jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
        # Advantage of the next policy step; reward of the rows before it.
        later_advantage, later_value, later_reward = carry
        row, value, following = x

        # At an episode's end the sum stops; after a truncation it includes the value of the final observation.
        end = row.terminated | row.truncated
        later_value = jnp.where(end, jnp.where(row.terminated, 0.0, following), later_value)
        later_advantage = jnp.where(end, 0.0, later_advantage)
        reward = row.reward + jnp.where(end, 0.0, later_reward)
        advantage = reward + gamma * (later_value + gae_lambda * later_advantage) - value

        # A row without a policy step passes its reward on to the policy step before it.
        carry = (
            jnp.where(row.valid, advantage, later_advantage),
            jnp.where(row.valid, value, later_value),
            jnp.where(row.valid, 0.0, reward),
        )
        return carry, advantage

    # Go backwards in time, because each row needs the next one.
    zeros = jnp.zeros_like(value[0])
    return jax.lax.scan(back, (zeros, following[-1], zeros), (rows, value, following), reverse=True)[1]


def loss(
    params: dict[str, PyTree], batch: Batch, config: PPOConfig, networks: ActorCritic
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the clipped PPO loss (Schulman et al. 2017) over the valid rows.

    Returns:
        The loss, and its parts by name; each of shape ``()``.
    """
    # Apply both networks; from here on, all rows of all copies are on one axis.
    critic = batch.x if batch.critic is None else batch.critic
    mean = _outputs(networks.actor, params["actor"], batch.actor_carry, batch.x, batch)
    value = _outputs(networks.critic, params["value"], batch.critic_carry, critic, batch)[:, 0]
    batch = jax.tree.map(_flat, batch._replace(actor_carry=(), critic_carry=()))
    weight = batch.weight / jnp.maximum(batch.weight.sum(), 1.0)

    # Probability ratio to the policy that played, and the KL divergence from it.
    squashed = batch.noise is not None
    log_ratio = jax.vmap(lambda u, m: log_prob(u, m, params["log_std"], squashed))(batch.u, mean) - batch.log_prob
    ratio = jnp.exp(log_ratio)

    # Entropy; tanh lowers it, by an average over the policy's samples.
    bonus = entropy(params["log_std"])
    if batch.noise is not None:
        drawn = mean + jnp.exp(params["log_std"]) * batch.noise
        bonus = bonus + jnp.sum(weight * jax.vmap(log_slope)(drawn))
    parts = {"entropy": bonus, "kl": jnp.sum(weight * (ratio - 1.0 - log_ratio))}

    # Clipped surrogate of the policy, with advantages of mean 0 and standard deviation 1.
    centred = batch.advantage - jnp.sum(weight * batch.advantage)
    advantage = centred / jnp.sqrt(jnp.sum(weight * centred**2) + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(advantage * ratio, advantage * clipped))

    # Clipped value loss. The target is batch.value + advantage: change - advantage is the distance from it.
    change = value - batch.value
    clipped_change = jnp.clip(change, -config.value_clip, config.value_clip)
    error = jnp.maximum((change - batch.advantage) ** 2, (clipped_change - batch.advantage) ** 2)
    value_loss = 0.5 * jnp.sum(weight * error)
    parts |= {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "clip_share": jnp.sum(jnp.where(jnp.abs(ratio - 1.0) > config.clip, weight, 0.0)),
    }
    return policy_loss + config.value_coef * value_loss - config.entropy_coef * bonus, parts


def _outputs(network: Network, params: PyTree, carry: PyTree, x: jax.Array, batch: Batch) -> jax.Array:
    """Return a network's outputs for ``x (N, T, inputs)``, shape ``(N T, outputs)``."""
    if not is_recurrent(network):
        # Give each part of the rows a copy of the parameters, and add up the gradients: a GPU computes the parts in
        # # parallel. Products over all 12,288 rows of a Go2's minibatch take an H200 24 ms of an update's 42 ms.
        rows = _flat(x)
        parts = _parts(rows.shape[0])
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (parts, *jnp.shape(leaf))), params)
        of_part = jax.vmap(lambda params, x: network.apply(params, carry, x)[1], (None, 0))
        return _flat(jax.vmap(of_part)(copies, rows.reshape(parts, -1, *rows.shape[1:])))
    rows = (jnp.swapaxes(leaf, 0, 1) for leaf in (x, batch.weight > 0, batch.end))
    return _flat(jnp.swapaxes(unroll(network, params, carry, *rows).y, 0, 1))


def _parts(rows: int) -> int:
    """Return the number of equal parts, of at least 256 rows each, whose gradients a GPU computes in parallel."""
    parts = 32 if jax.default_backend() == "gpu" else 1
    while parts > 1 and (rows % parts or rows < 256 * parts):
        parts //= 2
    return parts


def _flat(leaf: jax.Array) -> jax.Array:
    """Return an array with its two leading axes as one."""
    return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])
