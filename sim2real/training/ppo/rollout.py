"""Plays environments: training rollouts and evaluation episodes."""

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import TrainingEnvironment, get_privileged, get_width, metric_names, select
from sim2real.training.networks.policy import Policy
from sim2real.types import PyTree

T = TypeVar("T")


class Copies(NamedTuple):
    """N copies of an environment between two rows.

    Attributes:
        state: Leaves of shape ``(N, ...)``.
        observation: Shape ``(N, O)``.
        carry: The actor's memory; leaves of shape ``(N, ...)``.
        critic_carry: The value function's memory.
    """

    state: PyTree
    observation: jax.Array
    carry: PyTree = ()
    critic_carry: PyTree = ()


class Rows(NamedTuple):
    """T rows of N copies; see ``protocol.Step``.

    Attributes:
        observation: Shape ``(T, N, O)``.
        u: Shape ``(T, N, A)``: the policy's sample, before it is clipped and scaled to an action.
        reward: Shape ``(T, N)``: the reward times ``reward_scale``.
        terminated: Shape ``(T, N)``.
        truncated: Shape ``(T, N)``.
        valid: Shape ``(T, N)``.
        following: Shape ``(T, N, O)``: the observation after the row, before any reset.
        metrics: Name -> shape ``(T, N)``: the environment's metrics after the row.
        privileged: Shape ``(T, N, P)``: the value function's further inputs; None if it has none.
        privileged_following: Shape ``(T, N, P)``: these inputs after the row.
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


class PolicyEvaluation(NamedTuple):
    """One episode of each of N copies, as far as it is played.

    Attributes:
        running: Shape ``(N,)``, bool: the episode has not ended yet.
        terminated: Shape ``(N,)``, bool: it ended by a termination.
        figures: Name -> shape ``(N,)``: ``return``, the sum of the rewards, and the environment's metrics at the
            episode's end; a metric ``return`` replaces the sum.
    """

    running: jax.Array
    terminated: jax.Array
    figures: dict[str, jax.Array]


def repeat(carry: T, count: int) -> T:
    """Repeat a carry for each of N copies, leaves ``(N, ...)``."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), carry)


def collect(
    env: TrainingEnvironment,
    config: PPOConfig,
    policy: Policy,
    copies: Copies,
    update: jax.Array,
    key: jax.Array,
    evaluating: jax.Array | bool = False,
    reached: jax.Array | None = None,
) -> tuple[Copies, Rows]:
    """Play ``rollout_steps`` rows with exploration noise; a copy whose episode ends starts another one.

    Args:
        copies: The copies after the last rollout; if ``update`` is 0, all copies are reset.
        update: Shape ``()``, int32: number of updates so far; in an evaluation, number of rollouts.
        evaluating: Shape ``()``, bool: play without exploration noise, cut no episode, and draw episodes as at the end
            of the curriculum.
        reached: Shape ``()``: the share of a curriculum that follows success; None without such a curriculum.

    Returns:
        The copies after the rollout, and the rows.
    """
    count, rows = config.num_envs, config.rollout_steps
    key_reset, key_noise, key_step = jax.random.split(key, 3)

    # Draw one initial state per copy for the whole rollout, because a reset may take longer than a row.
    width = get_width(env, config, jnp.where(evaluating, config.updates, update), reached)
    initial = _reset(env, width, key_reset, count)
    fresh = Copies(*initial, repeat(policy.initial_carry(), count), copies.critic_carry)
    copies = select(jnp.broadcast_to(update == 0, (count,)), fresh, copies)

    # Draw the exploration noise of all rows.
    noise = jax.random.normal(key_noise, (rows, count, policy.low.shape[0]))
    noise = jnp.where(evaluating, 0.0, jnp.exp(policy.log_std)) * noise

    # Cut the first episodes after different numbers of rows. Otherwise all copies would be at the same time in their
    # # episodes, and each update would learn from only one phase of the task.
    cut = jnp.where(evaluating, 0, 1 + jnp.arange(count) * config.eval_steps // count)
    row = partial(_play_row, env, config, policy, fresh, cut)
    numbers = update * rows + jnp.arange(1, rows + 1)
    return jax.lax.scan(row, copies, (noise, jax.random.split(key_step, (rows, count)), numbers))


def _reset(env: TrainingEnvironment, width: jax.Array | None, key: jax.Array, count: int) -> tuple[PyTree, jax.Array]:
    """Start an episode in each of N copies, with a share ``width ()`` of the differences; None: no curriculum."""
    reset = env.reset if width is None else partial(env.reset, width=width)
    return jax.vmap(reset)(jax.random.split(key, count))


def _play_row(
    env: TrainingEnvironment,
    config: PPOConfig,
    policy: Policy,
    fresh: Copies,
    cut: jax.Array,
    now: Copies,
    x: tuple[jax.Array, jax.Array, jax.Array],
) -> tuple[Copies, Rows]:
    """Play one row of all copies.

    Args:
        cut: Shape ``(N,)``, int32: number of the row after which a copy's first episode ends.
        x: Exploration noise ``(N, A)``, keys ``(N,)``, and the row's number from 1 ``()``.
    """
    noise, keys, number = x

    # Act: the network's mean, the noise, then the environment.
    carry, mean = jax.vmap(policy.get_mean)(now.carry, now.observation)
    u = mean + noise
    step = jax.vmap(env.step)(now.state, jax.vmap(policy.to_action)(u), keys)
    truncated = step.truncated | (number == cut)

    # Record the row, with the further inputs of the value function if they are used.
    privileged = get_privileged(env, config)
    out = Rows(
        observation=now.observation,
        u=u,
        reward=config.reward_scale * step.reward,
        terminated=step.terminated,
        truncated=truncated,
        valid=step.valid,
        following=step.observation,
        metrics=step.metrics,
        privileged=None if privileged is None else jax.vmap(privileged)(now.state),
        privileged_following=None if privileged is None else jax.vmap(privileged)(step.state),
    )

    # Start another episode where this one ended; a row without a policy step leaves the actor's memory unchanged.
    following = Copies(step.state, step.observation, select(step.valid, carry, now.carry), now.critic_carry)
    return select(step.terminated | truncated, fresh, following), out


def new_evaluation(env: TrainingEnvironment, config: PPOConfig) -> PolicyEvaluation:
    """Return an evaluation without rows."""
    names = metric_names(env)
    zeros, no = jnp.zeros(config.num_envs), jnp.zeros(config.num_envs, bool)
    return PolicyEvaluation(~no, no, dict.fromkeys(["return", *names], zeros))


def add_rows(evaluation: PolicyEvaluation, rows: Rows, config: PPOConfig) -> PolicyEvaluation:
    """Return the evaluation after more rows; rows after a copy's first episode do not count."""
    end = rows.terminated | rows.truncated
    runs = evaluation.running & (jnp.cumsum(end, axis=0) - end == 0)  # (T, N): before each row
    last = runs & end

    # Rewards are summed over the episode, metrics are read in its last row.
    figures = {"return": rows.reward / config.reward_scale} | rows.metrics
    summed = {"return"} - set(rows.metrics)
    added = {n: jnp.where(runs if n in summed else last, v, 0.0).sum(0) for n, v in figures.items()}
    return PolicyEvaluation(
        running=evaluation.running & ~last.any(0),
        terminated=evaluation.terminated | (last & rows.terminated).any(0),
        figures={name: evaluation.figures[name] + value for name, value in added.items()},
    )


def averages(evaluation: PolicyEvaluation) -> dict[str, jax.Array]:
    """Return the means over the finished episodes, each of shape ``()``.

    ``finished`` is the share of episodes that ended, ``terminated`` the share of these that a termination ended.
    """
    running = evaluation.running
    share = jnp.mean(jnp.where(running, 0.0, 1.0))
    figures = {"terminated": jnp.where(evaluation.terminated, 1.0, 0.0)} | evaluation.figures
    return {n: jnp.mean(jnp.where(running, 0.0, v)) / share for n, v in figures.items()} | {"finished": share}


def evaluate(env: TrainingEnvironment, config: PPOConfig, policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
    """Play one episode per copy without exploration noise, and average over the episodes that ended.

    Returns:
        ``return`` (sum of the unscaled rewards, or the environment's metric of that name), the environment's metrics,
        ``finished``: the share of the episodes that ended within ``eval_steps`` rows, and ``terminated``: the share of
        those that a termination ended. Each of shape ``()``.
    """
    width = get_width(env, config, jnp.int32(0))
    shapes = jax.eval_shape(lambda: _reset(env, width, jax.random.key(0), config.num_envs))
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), Copies(*shapes))
    blank = blank._replace(carry=repeat(policy.initial_carry(), config.num_envs))

    def rollout(
        carry: tuple[Copies, PolicyEvaluation], x: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[Copies, PolicyEvaluation], None]:
        (copies, evaluation), (number, key) = carry, x
        copies, rows = collect(env, config, policy, copies, number, key, evaluating=True)
        return (copies, add_rows(evaluation, rows, config)), None

    start, numbers = (blank, new_evaluation(env, config)), jnp.arange(config.rollouts_per_evaluation)
    (_, evaluation), _ = jax.lax.scan(rollout, start, (numbers, jax.random.split(key, len(numbers))))
    return averages(evaluation)
