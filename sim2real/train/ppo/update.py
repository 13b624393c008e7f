"""One PPO update: a rollout, advantage estimates, and minibatch steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sim2real.policy.network import NetworkSpec
from sim2real.train.config import PPOConfig
from sim2real.train.environment.protocol import TrainingEnvironment
from sim2real.train.networks.normaliser import Normaliser, deviations, normalise_parameters, update_normaliser
from sim2real.train.networks.policy import Policy, log_prob
from sim2real.train.networks.sequences import ActorCritic, unroll
from sim2real.train.ppo.losses import Batch, gae, loss
from sim2real.train.ppo.optimiser import adapt_rate, get_rate, make_optimiser, set_rate
from sim2real.train.ppo.rollout import Copies, Rows
from sim2real.train.ppo.teacher import TeacherEnvironment
from sim2real.train.scale.mesh import spread


class TrainState(NamedTuple):
    """Everything that training carries from update to update, for one seed.

    Attributes:
        params: ``{"actor": ..., "log_std": (A,), "value": ...}``: those of the networks, and of the noise.
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


def make_policy(
    env: TrainingEnvironment, config: PPOConfig, networks: ActorCritic, params: dict[str, Any], normaliser: Normaliser
) -> Policy:
    """Return the policy with the given parameters and normaliser.

    Args:
        params: As in ``TrainState``.
    """
    known = env.privileged_size if isinstance(env, TeacherEnvironment) else 0
    return Policy(
        params=params["actor"],
        log_std=params["log_std"],
        mean=normaliser.mean,
        std=deviations(normaliser, known),
        low=jnp.asarray(env.action_low, jnp.float32),
        high=jnp.asarray(env.action_high, jnp.float32),
        network=networks.actor,
        spec=NetworkSpec(networks.name, config.squash, known),
    )


def prepare(
    state: TrainState, policy: Policy, rows: Rows, config: PPOConfig, networks: ActorCritic
) -> tuple[Batch, Any]:
    """Return the batch of a rollout: normalised observations, values, log densities and advantages.

    Args:
        state: The state before the rollout; its value network and normalisers are used.
        policy: The policy that played the rows.

    Returns:
        The batch, and what the value function carries on after the last row.
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
    end, copies, squash = rows.terminated | rows.truncated, state.copies, policy.spec.squash
    played = unroll(networks.actor, policy.params, copies.carry, x, rows.valid, end).y
    judge = unroll(
        networks.critic, state.params["value"], copies.critic_carry, critic, rows.valid, end, critic_following
    )
    value, following = judge.y[..., 0], jnp.asarray(judge.following)[..., 0]
    batch = Batch(
        x=x,
        critic=None if state.privileged is None else critic,
        u=rows.u,
        log_prob=over_rows(lambda u, mean: log_prob(u, mean, policy.log_std, squash), rows.u, played),
        value=value,
        advantage=gae(rows, value, following, config.gamma, config.gae_lambda),
        weight=rows.valid.astype(jnp.float32),
        advice=rows.advice,
        noise=(rows.u - played) * jnp.exp(-policy.log_std) if squash else None,
        end=end,
        actor_carry=(),
        critic_carry=(),
    )
    batch = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), batch)
    return batch._replace(actor_carry=copies.carry, critic_carry=copies.critic_carry), judge.carry


def keys(state: TrainState) -> jax.Array:
    """Return three keys of the next update: for its rollout, for its shuffles, and for an evaluation before it.

    They depend on the seed and the number of the update alone, so the number of evaluations does not affect training.
    """
    return jax.random.split(jax.random.fold_in(state.key, state.update), 3)


def update(
    env: TrainingEnvironment,
    config: PPOConfig,
    networks: ActorCritic,
    state: TrainState,
    copies: Copies,
    rows: Rows,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Update the networks and the normaliser after a rollout.

    Each minibatch has all rows of some of the copies: shuffling N indices is cheap, a copy's rows are adjacent in
    memory, and networks that remember need them in their order. The normaliser is updated after the networks: log
    densities are those of the policy that played the rows.

    Args:
        rows: What they played, by the policy of that state.

    Returns:
        The next state, and figures of the update: the parts of the loss and the mean ``reward`` and ``value`` per row,
        unscaled, each of shape ``()``; ``finite_observation``, shape ``(O,)``, bool; and ``finite_privileged``, shape
        ``(P,)``, bool, where the value function sees more.
    """
    policy = make_policy(env, config, networks, state.params, state.normaliser)
    batch, critic_carry = prepare(state, policy, rows, config, networks)
    copies = copies._replace(critic_carry=critic_carry)
    optimiser = make_optimiser(config)

    def minibatch(carry: _Learnt, part: Batch) -> tuple[_Learnt, dict[str, jax.Array]]:
        params, optimiser_state = carry
        (total, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params, part, config, networks)
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
        jax.random.split(keys(state)[1], config.epochs)
    )
    (params, optimiser_state), parts = jax.lax.scan(epoch, (state.params, state.optimiser), shuffles)
    stats = jax.tree.map(jnp.mean, parts) | {
        "reward": jnp.mean(rows.reward) / config.reward_scale,
        "value": jnp.sum(batch.weight * batch.value) / jnp.maximum(batch.weight.sum(), 1.0) / config.reward_scale,
        "finite_observation": jnp.isfinite(rows.following).all((0, 1)),
    }
    if rows.privileged_following is not None:
        stats |= {"finite_privileged": jnp.isfinite(rows.privileged_following).all((0, 1))}
    return TrainState(params, optimiser_state, *_normalisers(state, rows), copies, state.update + 1, state.key), stats


def _normalisers(state: TrainState, rows: Rows) -> tuple[Normaliser, Normaliser | None]:
    normaliser = update_normaliser(state.normaliser, rows.observation, rows.valid)
    if state.privileged is None or rows.privileged is None:
        return normaliser, None
    return normaliser, update_normaliser(state.privileged, rows.privileged, rows.valid)
