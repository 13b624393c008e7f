"""The training task of a graph, and the terms of its reward. Imports no JAX."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sim2real.artifacts.bundle import REWARD as REWARD
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.later import jax, jnp
from sim2real.types import PyTree

if TYPE_CHECKING:
    Rewards: TypeAlias = jax.Array | Mapping[str, jax.Array]
    """The reward of a row, shape ``()``, or its terms by name, which are added up."""
else:
    Rewards = PyTree


class TrainingTask(ABC):
    """The training task of a graph: observation, action, reward and success.

    Attributes:
        supervisor: Name of the node whose steps the policy makes.
        action_low: Shape ``(A,)``: lower bounds of the action [the command's unit].
        action_high: Shape ``(A,)``: upper bounds of the action [the command's unit].
        has_curriculum: Whether ``params`` uses its argument ``width``.
        privileged: Returns true quantities of a graph's state ``(P,)``, for a value function; None: none.
    """

    supervisor: str
    observation_size: int
    action_low: np.ndarray
    action_high: np.ndarray
    has_curriculum: bool = False
    privileged: Callable[[GraphState], jax.Array] | None = None

    @abstractmethod
    def params(self, key: jax.Array, width: jax.Array | None = None) -> dict[str, PyTree]:
        """Draw the parameters of the graph's nodes for an episode; ``width``: share of the differences; None: 1."""

    @abstractmethod
    def observe(self, step_state: StepState) -> jax.Array:
        """Return the policy's observation, shape ``(observation_size,)``, from the supervisor's step state."""

    @abstractmethod
    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, PyTree]:
        """Return the supervisor's new step state and its output for an action, shape ``(A,)``."""

    @abstractmethod
    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        """Return the reward of a row, or its terms by name, each of shape ``()``, for an ``action (A,)``."""

    @abstractmethod
    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the task is fulfilled in the graph's state after a row, bool of shape ``()``."""

    def terminated(self, graph_state: GraphState) -> jax.Array:
        """Return whether the episode ended in the graph's state after a row, bool of shape ``()``; default: never."""
        return jnp.bool_(False)


def checked_end(ended: jax.Array, task: object) -> jax.Array:
    """Return the result of a task's ``terminated``, checked to be one bool."""
    ended = jnp.asarray(ended)
    if ended.shape != () or ended.dtype != jnp.bool_:
        raise UsageError(
            f"`terminated` of {type(task).__name__} must return a bool of shape (), got {ended.dtype} of shape "
            f"{ended.shape}",
            hint="compare with a limit, and join several by jnp.any",
        )
    return ended


def terms_of(reward: Rewards) -> dict[str, jax.Array]:
    """Return the terms of a reward by name; none if it is a single number."""
    return dict(reward) if isinstance(reward, Mapping) else {}


def total_of(reward: Rewards) -> jax.Array:
    """Return a reward, shape ``()``: the sum of its terms, in their order."""
    if not isinstance(reward, Mapping):
        return reward
    if not reward:
        raise UsageError("the task's reward has no terms", hint="return a number, or terms by name")
    return reduce(add, reward.values())
