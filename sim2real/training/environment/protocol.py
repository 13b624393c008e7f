"""The protocol of PPO's environments: pure functions of one copy.

One call of ``step`` is called a row. The policy makes a step only in rows marked ``valid``; in other rows its action is
ignored, and the observation is already the input of the next policy step::

    row          0        1        2        3 valid        yes      no       yes      yes observation  o0  ->   o1  ->
    o1  ->   o3       o1: the policy's input in row 2 reward       r0       r1       r2       r3       r1 is added to
    r0, without a discount terminated   no       no       no       yes      row 3's observation is the final one; reset
    before the next row

An episode ends in a row with ``terminated`` (the value after it is 0) or ``truncated`` (the value after it is estimated
from the observation that the row returned). If both are set, the row counts as terminated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.types import PyTree

T = TypeVar("T")


class Step(NamedTuple):
    """The result of one row.

    Attributes:
        state: The next state, with the structure that ``reset`` returned.
        observation: Shape ``(O,)``: observation of the next policy step, also after the episode's last row.
        reward: Shape ``()``.
        terminated: Shape ``()``, bool: the task ended the episode, e.g. after a fall.
        truncated: Shape ``()``, bool: the episode was cut, e.g. by a time limit.
        valid: Shape ``()``, bool: the policy made a step in this row.
        metrics: Name -> shape ``()``: values of the whole episode; used only in the row that ends it.
    """

    state: PyTree
    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array
    metrics: dict[str, jax.Array]


class TrainingEnvironment:
    """One copy of an environment; ``reset`` and ``step`` are pure and PPO vmaps them.

    Attributes:
        observation_size: Number of entries O of an observation.
        action_low: Shape ``(A,)``: lower bounds of the action [the action's units].
        action_high: Shape ``(A,)``: upper bounds of the action [the action's units].
        curriculum: Share of the differences between episodes at the first and at the last update; None: always 1.
        follow: Metric ``success`` above which the share grows; 0: it grows with the updates.
        privileged: Returns quantities of a state that the policy does not observe ``(P,)``; None: none.
    """

    observation_size: int
    action_low: np.ndarray
    action_high: np.ndarray
    curriculum: tuple[float, float] | None = None
    follow: float = 0.0
    privileged: Callable[[Any], jax.Array] | None = None

    def reset(self, key: jax.Array, width: jax.Array | None = None) -> tuple[Any, jax.Array]:
        """Return the state at the start of an episode and the first observation, shape ``(O,)``.

        Args:
            width: Shape ``()``: share of the differences; None: the last of the curriculum. An environment without a
                curriculum needs no such argument.
        """
        raise NotImplementedError

    def step(self, state: Any, action: jax.Array, key: jax.Array) -> Step:
        """Play one row; ``action (A,)`` within the bounds [the action's units]."""
        raise NotImplementedError


def get_privileged(env: TrainingEnvironment, config: PPOConfig) -> Callable[[PyTree], jax.Array] | None:
    """Return the function from a state to its privileged entries; None if ``config.privileged`` is off.

    Raises:
        UsageError: The environment has no privileged entries.
    """
    if config.privileged and env.privileged is None:
        raise UsageError(
            f"a {type(env).__name__} has no privileged entries for a value function",
            hint="give it, or its task, a method privileged(state) -> (P,), or train without --ppo.privileged",
        )
    return env.privileged if config.privileged else None


QUICKEST = 0.25
"""A curriculum that follows success reaches its last share within this share of the updates at the earliest."""


def get_width(
    env: TrainingEnvironment, config: PPOConfig, update: jax.Array, reached: jax.Array | None = None
) -> jax.Array | None:
    """Return the share of the differences, shape ``()``, after ``update`` updates; None without a curriculum.

    Args:
        reached: The present share of a curriculum that follows success; not used if ``update >= config.updates``, as in
            an evaluation.
    """
    if env.curriculum is None:
        return None
    first, last = env.curriculum
    if reached is not None:
        return jnp.where(update >= config.updates, jnp.float32(last), reached)
    return jnp.float32(first) + (last - first) * jnp.clip(update / max(config.updates - 1, 1), 0.0, 1.0)


def widen(
    env: TrainingEnvironment, config: PPOConfig, reached: jax.Array, success: jax.Array, ended: jax.Array
) -> jax.Array:
    """Return the share of the differences after a rollout, which grows if the finished episodes were successful.

    Args:
        success: Shape ``(T, N)``: the metric of each row.
        ended: Shape ``(T, N)``, bool: the episode ended in the row.
    """
    if env.curriculum is None:
        return reached
    first, last = env.curriculum
    mean = jnp.sum(jnp.where(ended, success, 0.0)) / jnp.maximum(jnp.sum(ended), 1)
    growth = (last - first) / max(QUICKEST * config.updates, 1.0)
    return jnp.where(mean > env.follow, jnp.minimum(reached + growth, last), reached)


def check_environment(env: TrainingEnvironment) -> None:
    """Check shapes and dtypes of an environment's results by tracing it, without compiling or running it.

    Raises:
        UsageError: A part does not follow the protocol.
    """
    # Bounds of the action.
    size, low, high = env.observation_size, np.asarray(env.action_low), np.asarray(env.action_high)
    if low.ndim != 1 or low.shape != high.shape or not (np.isfinite([low, high]).all() and (low < high).all()):
        raise UsageError(
            f"action bounds must be two finite vectors with low < high, got low={low} and high={high}",
            hint="leave out actions that cannot move, and give every other one its physical limits",
        )

    # Observations of reset and step.
    key = jax.eval_shape(lambda: jax.random.key(0))
    start, observation = jax.eval_shape(env.reset, key)
    step = jax.eval_shape(env.step, start, jax.ShapeDtypeStruct(low.shape, np.float32), key)
    for name, leaf in (("reset's", observation), ("step's", step.observation)):
        if leaf.shape != (size,):
            raise UsageError(f"{name} observation has shape {leaf.shape}, but observation_size is {size}")

    # Numbers and flags of a step, then the state.
    scalars = {"reward": step.reward, **{f"metrics[{name!r}]": leaf for name, leaf in step.metrics.items()}}
    flags = {"terminated": step.terminated, "truncated": step.truncated, "valid": step.valid}
    for name, leaf in (scalars | flags).items():
        if leaf.shape != () or (name in flags and leaf.dtype != np.bool_):
            kind = "a bool" if name in flags else "a number"
            raise UsageError(f"step's {name} must be {kind} of shape (), got {leaf.dtype} of shape {leaf.shape}")
    _check_state(start, step.state)


def metric_names(env: TrainingEnvironment) -> set[str]:
    """Return the names of an environment's metrics, by tracing it."""
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct(np.shape(env.action_low), np.float32)
    return set(jax.eval_shape(env.step, jax.eval_shape(env.reset, key)[0], action, key).metrics)


def choose(condition: jax.Array, new: T, old: T) -> T:
    """Return ``new`` if ``condition``, shape ``()``, is true, else ``old``."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def to_vector(observation: PyTree) -> jax.Array:
    """Return an observation as one vector ``(O,)``: a dictionary's observables one after the other, in their order."""
    parts = [jnp.ravel(value) for value in (observation.values() if isinstance(observation, dict) else [observation])]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def select(mask: jax.Array, new: T, old: T) -> T:
    """Return ``new`` where ``mask (N,)`` is true, else ``old``, for each of N copies; leaves ``(N, ...)``."""

    def one(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(one, new, old)


def _check_state(start: object, after: object) -> None:
    """Compare the states that ``reset`` and ``step`` return, leaf by leaf."""
    if jax.tree.structure(start) != jax.tree.structure(after):
        raise UsageError(
            f"reset and step return states of different structure: {jax.tree.structure(start)} and "
            f"{jax.tree.structure(after)}",
            hint="a row may change the values in a state, but not its structure",
        )
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(start), jax.tree.leaves(after), strict=True):
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            raise UsageError(
                f"state{jax.tree_util.keystr(path)} is {a.dtype} of shape {a.shape} after reset and "
                f"{b.dtype} of shape {b.shape} after step",
                hint="give it the same type in both, e.g. jnp.float32(0) in place of 0",
            )
