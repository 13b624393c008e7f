"""What an update minimises: the loss of PPO, and the advantages that it is made of."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sim2real.train.config import PPOConfig
from sim2real.train.networks.architectures import Network, is_recurrent
from sim2real.train.networks.policy import entropy, log_prob, log_slope
from sim2real.train.networks.sequences import ActorCritic, unroll
from sim2real.train.ppo.rollout import Rows

LEAST_LOG_STD = -3.0
"""Least logarithm of a student's noise, as the likelihood of what it imitates perfectly has no bound."""


class Batch(NamedTuple):
    """Rows prepared for the loss: T of each of N copies.

    Attributes:
        x: Shape ``(N, T, O)``: normalised observations.
        critic: Shape ``(N, T, O + P)``: what the value function is given; None: it is ``x``.
        u: Shape ``(N, T, A)``: the policy's samples.
        log_prob: Shape ``(N, T)``: log density of ``u`` under the policy that drew it.
        value: Shape ``(N, T)``: value estimates before the update.
        advantage: Shape ``(N, T)``.
        weight: Shape ``(N, T)``: 1 in rows with a policy step, else 0.
        advice: Shape ``(N, T, A)``: what a teacher would have done, within [-1, 1]; None: there is none.
        noise: Shape ``(N, T, A)``: ``u`` in deviations from its mean; None where actions are not squashed.
        end: Shape ``(N, T)``, bool: rows that end an episode.
        actor_carry: What the actor carried into the first row; leaves of shape ``(N, ...)``.
        critic_carry: The same of the value function.
    """

    x: jax.Array
    critic: jax.Array | None
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    weight: jax.Array
    advice: jax.Array | None
    noise: jax.Array | None
    end: jax.Array
    actor_carry: Any
    critic_carry: Any


def gae(rows: Rows, value: jax.Array, following: jax.Array, gamma: float, gae_lambda: float) -> jax.Array:
    """Return generalised advantage estimates (Schulman et al. 2016) of rows, some of which have no policy step.

    The reward of a row without a policy step is added, undiscounted, to the reward of the policy step before it; the
    discount applies once per policy step. At an episode's end the sum stops; after truncation the value of the final
    observation is added.

    Args:
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


def loss(
    params: dict[str, Any], batch: Batch, config: PPOConfig, networks: ActorCritic
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the clipped PPO loss (Schulman et al. 2017) over the valid rows; with a teacher, that of imitating it.

    Args:
        params: As in ``TrainState``.

    Returns:
        The loss, and its parts by name; each of shape ``()``.
    """
    seen = batch.x if batch.critic is None else batch.critic
    mean = _outputs(networks.actor, params["actor"], batch.actor_carry, batch.x, batch)
    value = _outputs(networks.critic, params["value"], batch.critic_carry, seen, batch)[:, 0]
    batch = jax.tree.map(_flat, batch._replace(actor_carry=(), critic_carry=()))
    weight = batch.weight / jnp.maximum(batch.weight.sum(), 1.0)
    squashed = batch.noise is not None
    log_ratio = jax.vmap(lambda u, m: log_prob(u, m, params["log_std"], squashed))(batch.u, mean) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    bonus = entropy(params["log_std"])
    if batch.noise is not None:  # what tanh takes away, on average over the policy's own samples
        drawn = mean + jnp.exp(params["log_std"]) * batch.noise
        bonus = bonus + jnp.sum(weight * jax.vmap(log_slope)(drawn))
    parts = {"entropy": bonus, "kl": jnp.sum(weight * (ratio - 1.0 - log_ratio))}
    if batch.advice is not None:
        guess = jnp.tanh(mean) if squashed else mean
        return _imitation(guess, batch.advice, jnp.maximum(params["log_std"], LEAST_LOG_STD), weight, parts)
    centred = batch.advantage - jnp.sum(weight * batch.advantage)
    advantage = centred / jnp.sqrt(jnp.sum(weight * centred**2) + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(advantage * ratio, advantage * clipped))
    moved = value - batch.value
    held = jnp.clip(moved, -config.value_clip, config.value_clip)
    # The target is value + advantage, so its distance from value + moved is moved - advantage.
    error = jnp.maximum((moved - batch.advantage) ** 2, (held - batch.advantage) ** 2)
    value_loss = 0.5 * jnp.sum(weight * error)
    parts |= {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "clip_share": jnp.sum(jnp.where(jnp.abs(ratio - 1.0) > config.clip, weight, 0.0)),
    }
    return policy_loss + config.value_coef * value_loss - config.entropy_coef * bonus, parts


def _imitation(
    guess: jax.Array, advice: jax.Array, log_std: jax.Array, weight: jax.Array, parts: dict[str, jax.Array]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the negative log likelihood of a teacher's actions (DAgger, Ross et al. 2011, on the newest rollout).

    The policy acts, so its own mistakes are what it is corrected in. The noise that it acts with becomes as large as
    what it cannot tell.
    """
    likelihood = jax.vmap(lambda a, g: log_prob(a, g, log_std))(advice, guess)
    error = jnp.sqrt(jnp.sum(weight * jnp.mean((guess - advice) ** 2, -1)))
    return -jnp.sum(weight * likelihood), parts | {"imitation_error": error}


def _outputs(network: Network, params: Any, carry: Any, x: jax.Array, batch: Batch) -> jax.Array:
    """Return a network's outputs for ``x (N, T, inputs)``, shape ``(N T, outputs)``."""
    if not is_recurrent(network):
        return jax.vmap(lambda x: network.apply(params, carry, x)[1])(_flat(x))
    rows = (jnp.swapaxes(leaf, 0, 1) for leaf in (x, batch.weight > 0, batch.end))
    return _flat(jnp.swapaxes(unroll(network, params, carry, *rows).y, 0, 1))


def _flat(leaf: jax.Array) -> jax.Array:
    """Return an array with its two leading axes as one."""
    return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])
