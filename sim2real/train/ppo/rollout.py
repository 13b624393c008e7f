"""Plays environments: training rollouts and evaluation episodes."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from sim2real.train.config import PPOConfig
from sim2real.train.environment.protocol import TrainingEnvironment, get_privileged, get_reset, metric_names
from sim2real.train.networks.policy import Policy
from sim2real.train.ppo.teacher import advice


class Copies(NamedTuple):
    """N copies of an environment between two rows.

    Attributes:
        state: Their states; leaves of shape ``(N, ...)``.
        observation: Shape ``(N, O)``: their observations.
        carry: What the actor carries from step to step; leaves of shape ``(N, ...)``.
        critic_carry: The same of the value function.
    """

    state: Any
    observation: jax.Array
    carry: Any = ()
    critic_carry: Any = ()


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
        metrics: Name -> shape ``(T, N)``: the environment's, after the row.
        privileged: Shape ``(T, N, P)``: what the value function sees besides the observation; None: nothing.
        privileged_following: Shape ``(T, N, P)``: the same after the row.
        advice: Shape ``(T, N, A)``: what a teacher would have done; None: there is none.
    """

    observation: jax.Array
    u: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array
    following: jax.Array
    metrics: dict[str, jax.Array]
    privileged: jax.Array | None = None
    privileged_following: jax.Array | None = None
    advice: jax.Array | None = None


class Tested(NamedTuple):
    """What N copies have shown in a test: one episode each.

    Attributes:
        running: Shape ``(N,)``, bool: the episode has not ended yet.
        terminated: Shape ``(N,)``, bool: it ended by itself.
        figures: Name -> shape ``(N,)``: ``return``, the sum of the rewards, and the environment's metrics, which may
            have a ``return`` of their own, as they were at the end.
    """

    running: jax.Array
    terminated: jax.Array
    figures: dict[str, jax.Array]


def pick(condition: jax.Array, new: T, old: T) -> T:
    """Return ``new`` or ``old``.

    Args:
        condition: Shape ``()``, bool: whether it is ``new``.
        old: Like ``new``.
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


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


def spread(carry: T, count: int) -> T:
    """Return what is carried into a first step for each of N copies."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), carry)


def collect(
    env: TrainingEnvironment,
    config: PPOConfig,
    policy: Policy,
    copies: Copies,
    update: jax.Array,
    key: jax.Array,
    teacher: Policy | None = None,
    testing: jax.Array | bool = False,
) -> tuple[Copies, Rows]:
    """Play ``rollout_steps`` rows with exploration noise; a copy whose episode ends starts another one.

    As a reset may cost more than a row, each copy has one reset state for the whole rollout, from which all its new
    episodes start. In the first rollout every copy starts with a reset. The first episodes are cut after different
    numbers of rows; otherwise all copies would stay at the same time of their episodes, and each update would see only
    one phase of the task.

    Args:
        env: The environment; vmapped here.
        policy: The policy; it does not change during the rollout.
        copies: The copies after the last rollout; ignored if ``update`` is 0.
        update: Shape ``()``, int32: number of updates so far, in a test of rollouts.
        key: Source of resets, noise and the environment's own randomness.
        teacher: Whose advice is asked for in every row, while the policy acts.
        testing: Shape ``()``, bool: play without exploration noise, cut no episode, and have all differences between
            episodes, as at the end of a curriculum; default: false.

    Returns:
        The copies after the rollout, and the rows.
    """
    count, rows = config.num_envs, config.rollout_steps
    key_reset, key_noise, key_step = jax.random.split(key, 3)
    widened = jnp.where(testing, config.updates, update)
    begun = jax.vmap(get_reset(env, config, widened))(jax.random.split(key_reset, count))
    fresh = Copies(*begun, spread(policy.initial_carry(), count), copies.critic_carry)
    copies = select(jnp.broadcast_to(update == 0, (count,)), fresh, copies)
    noise = jax.random.normal(key_noise, (rows, count, policy.low.shape[0]))
    std = jnp.where(testing, 0.0, jnp.exp(policy.log_std))
    see = get_privileged(env, config)
    cut = jnp.where(testing, 0, 1 + jnp.arange(count) * config.eval_steps // count)

    def row(now: Copies, x: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Copies, Rows]:
        noise, keys, number = x
        carry, mean = jax.vmap(policy.get_mean)(now.carry, now.observation)
        u = mean + std * noise
        step = jax.vmap(env.step)(now.state, jax.vmap(policy.to_action)(u), keys)
        truncated = step.truncated | (number == cut)
        following = Copies(step.state, step.observation, select(step.valid, carry, now.carry), now.critic_carry)
        out = Rows(
            observation=now.observation,
            u=u,
            reward=config.reward_scale * step.reward,
            terminated=step.terminated,
            truncated=truncated,
            valid=step.valid,
            following=step.observation,
            metrics=step.metrics,
            privileged=None if see is None else jax.vmap(see)(now.state),
            privileged_following=None if see is None else jax.vmap(see)(step.state),
            advice=None if teacher is None else jax.vmap(partial(advice, env, teacher))(now.state, now.observation),
        )
        return select(step.terminated | truncated, fresh, following), out

    numbers = update * rows + jnp.arange(1, rows + 1)
    return jax.lax.scan(row, copies, (noise, jax.random.split(key_step, (rows, count)), numbers))


def untested(env: TrainingEnvironment, config: PPOConfig) -> Tested:
    """Return what is known before a test."""
    names = metric_names(env)
    zeros, no = jnp.zeros(config.num_envs), jnp.zeros(config.num_envs, bool)
    return Tested(~no, no, dict.fromkeys(["return", *names], zeros))


def watch(tested: Tested, rows: Rows, config: PPOConfig) -> Tested:
    """Return what is known after more rows of a test."""
    end = rows.terminated | rows.truncated
    runs = tested.running & (jnp.cumsum(end, axis=0) - end == 0)  # (T, N): before each row
    last = runs & end
    figures = {"return": rows.reward / config.reward_scale} | rows.metrics
    own = "return" in rows.metrics
    kept = {n: jnp.where(runs if n == "return" and not own else last, v, 0.0).sum(0) for n, v in figures.items()}
    return Tested(
        running=tested.running & ~last.any(0),
        terminated=tested.terminated | (last & rows.terminated).any(0),
        figures={name: tested.figures[name] + value for name, value in kept.items()},
    )


def figures_of(tested: Tested) -> dict[str, jax.Array]:
    """Return the figures' means over the episodes that ended, each of shape ``()``.

    With them ``finished``, the share of the episodes that ended, and ``terminated``, that of those which did by
    themselves.
    """
    share = jnp.mean(jnp.where(tested.running, 0.0, 1.0))
    figures = {"terminated": jnp.where(tested.terminated, 1.0, 0.0)} | tested.figures
    return {n: jnp.mean(jnp.where(tested.running, 0.0, v)) / share for n, v in figures.items()} | {"finished": share}


def evaluate(env: TrainingEnvironment, config: PPOConfig, policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
    """Play one episode per copy without exploration noise, and average over the episodes that ended.

    Args:
        env: The environment; vmapped here.

    Returns:
        ``return`` (sum of the unscaled rewards, unless the environment's metrics have one), the environment's metrics,
        ``finished``: the fraction of the episodes that ended within ``eval_steps`` rows, and ``terminated``: the
        fraction of those that ended by themselves. Each of shape ``()``.
    """
    reset = get_reset(env, config, jnp.int32(0))
    shapes = jax.eval_shape(lambda: jax.vmap(reset)(jax.random.split(jax.random.key(0), config.num_envs)))
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), Copies(*shapes))
    blank = blank._replace(carry=spread(policy.initial_carry(), config.num_envs))

    def rollout(carry: tuple[Copies, Tested], x: tuple[jax.Array, jax.Array]) -> tuple[tuple[Copies, Tested], None]:
        (copies, tested), (number, own) = carry, x
        played, rows = collect(env, config, policy, copies, number, own, testing=True)
        return (played, watch(tested, rows, config)), None

    start, numbers = (blank, untested(env, config)), jnp.arange(config.rollouts_per_test)
    (_, tested), _ = jax.lax.scan(rollout, start, (numbers, jax.random.split(key, len(numbers))))
    return figures_of(tested)
