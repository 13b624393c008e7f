"""Plays environments: training rollouts and evaluation episodes."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from sim2real.train.config import PPOConfig
from sim2real.train.networks import Policy
from sim2real.train.protocol import TrainingEnvironment, get_privileged, get_reset


class Copies(NamedTuple):
    """N copies of an environment between two rows.

    Attributes:
        state: Their states; leaves of shape ``(N, ...)``.
        observation: Shape ``(N, O)``: their observations.
    """

    state: Any
    observation: jax.Array


T = TypeVar("T")


class Rows(NamedTuple):
    """T rows of N copies; see ``protocol.Step``.

    Attributes:
        observation: Shape ``(T, N, O)``: the policy's observation.
        u: Shape ``(T, N, A)``: the policy's sample, before it is clipped and scaled to an action.
        reward: Shape ``(T, N)``: the reward times ``reward_scale``.
        terminated: Shape ``(T, N)``.
        truncated: Shape ``(T, N)``.
        valid: Shape ``(T, N)``.
        following: Shape ``(T, N, O)``: the observation after the row, before any reset.
        privileged: Shape ``(T, N, P)``: what the value function sees besides the observation; None: nothing.
        privileged_following: Shape ``(T, N, P)``: the same after the row.
    """

    observation: jax.Array
    u: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array
    following: jax.Array
    privileged: jax.Array | None = None
    privileged_following: jax.Array | None = None


_Carry = tuple[Copies, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]
"""Copies, which of them run, which ended by themselves, their returns, and their metrics."""


def select(mask: jax.Array, new: T, old: T) -> T:
    """Return ``new`` where ``mask`` is true, else ``old``, for each of N copies.

    Args:
        mask: Shape ``(N,)``, bool.
        new: Leaves of shape ``(N, ...)``.
        old: Like ``new``.
    """

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(pick, new, old)


def collect(
    env: TrainingEnvironment, config: PPOConfig, policy: Policy, copies: Copies, update: jax.Array, key: jax.Array
) -> tuple[Copies, Rows]:
    """Play ``rollout_steps`` rows with exploration noise; a copy whose episode ends starts another one.

    As a reset may cost more than a row, each copy has one reset state for the whole rollout, from which all its new
    episodes start. In the first rollout every copy starts with a reset. The first episodes are cut after different
    numbers of rows; otherwise all copies would stay at the same time of their episodes, and each update would see only
    one phase of the task.

    Args:
        env: The environment; vmapped here.
        config: Numbers of copies and rows.
        policy: The policy; it does not change during the rollout.
        copies: The copies after the last rollout; ignored if ``update`` is 0.
        update: Shape ``()``, int32: number of updates so far.
        key: Source of resets, noise and the environment's own randomness.

    Returns:
        The copies after the rollout, and the rows.
    """
    count, rows = config.num_envs, config.rollout_steps
    key_reset, key_noise, key_step = jax.random.split(key, 3)
    fresh = Copies(*jax.vmap(get_reset(env, config, update))(jax.random.split(key_reset, count)))
    copies = select(jnp.broadcast_to(update == 0, (count,)), fresh, copies)
    noise = jax.random.normal(key_noise, (rows, count, policy.low.shape[0]))
    spread = jnp.exp(policy.log_std)
    see = get_privileged(env, config)
    cut = 1 + jnp.arange(count) * config.eval_steps // count

    def row(now: Copies, x: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Copies, Rows]:
        noise, keys, number = x
        u = jax.vmap(lambda observation, z: policy.get_mean(observation) + spread * z)(now.observation, noise)
        step = jax.vmap(env.step)(now.state, jax.vmap(policy.to_action)(u), keys)
        truncated = step.truncated | (number == cut)
        following = Copies(step.state, step.observation)
        out = Rows(
            observation=now.observation,
            u=u,
            reward=config.reward_scale * step.reward,
            terminated=step.terminated,
            truncated=truncated,
            valid=step.valid,
            following=step.observation,
            privileged=None if see is None else jax.vmap(see)(now.state),
            privileged_following=None if see is None else jax.vmap(see)(step.state),
        )
        return select(step.terminated | truncated, fresh, following), out

    numbers = update * rows + jnp.arange(1, rows + 1)
    return jax.lax.scan(row, copies, (noise, jax.random.split(key_step, (rows, count)), numbers))


def evaluate(env: TrainingEnvironment, config: PPOConfig, policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
    """Play one episode per copy without exploration noise, and average over the episodes that ended.

    Args:
        env: The environment; vmapped here.
        config: Numbers of copies and rows.
        policy: The policy.
        key: Source of resets and the environment's own randomness.

    Returns:
        ``return`` (sum of the unscaled rewards, unless the environment's metrics have one), the environment's metrics,
        ``finished``: the fraction of the episodes that ended within ``eval_steps`` rows, and ``terminated``: the
        fraction of those that ended by themselves. Each of shape ``()``.
    """
    key_reset, key_step = jax.random.split(key)
    copies = Copies(*jax.vmap(env.reset)(jax.random.split(key_reset, config.eval_envs)))
    names = jax.eval_shape(lambda key: env.step(env.reset(key)[0], policy.low, key).metrics, key)
    zeros = jnp.zeros(config.eval_envs)
    running = jnp.ones(config.eval_envs, bool)
    start = (copies, running, ~running, zeros, {name: zeros for name in names})

    def row(carry: _Carry, key: jax.Array) -> tuple[_Carry, None]:
        copies, running, fallen, total, metrics = carry
        keys = jax.random.split(key, config.eval_envs)
        step = jax.vmap(env.step)(copies.state, jax.vmap(policy.get_action)(copies.observation), keys)
        ends = running & (step.terminated | step.truncated)
        total = total + jnp.where(running, step.reward, 0.0)
        metrics = {name: jnp.where(ends, value, metrics[name]) for name, value in step.metrics.items()}
        fallen = fallen | (ends & step.terminated)
        return (Copies(step.state, step.observation), running & ~ends, fallen, total, metrics), None

    (_, running, fallen, total, metrics), _ = jax.lax.scan(row, start, jax.random.split(key_step, config.eval_steps))
    share = jnp.mean(jnp.where(running, 0.0, 1.0))
    figures = {"terminated": jnp.where(fallen, 1.0, 0.0), "return": total} | metrics
    mean = {name: jnp.mean(jnp.where(running, 0.0, v)) / share for name, v in figures.items()}
    return mean | {"finished": share}
