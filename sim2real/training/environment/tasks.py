"""Optional methods of a training task: termination, privileged entries, a curriculum; and the terms of a reward."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from sim2real.artifacts.bundle import REWARD as REWARD
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.later import jax, jnp
from sim2real.types import PyTree

if TYPE_CHECKING:
    Rewards: TypeAlias = jax.Array | Mapping[str, jax.Array]
    """The reward of a row, shape ``()``, or its terms by name, whose sum it is."""
else:
    Rewards = PyTree


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


@runtime_checkable
class EndingTask(Protocol):
    """A task that may end an episode before its time, such as a fall."""

    def terminated(self, graph_state: GraphState) -> jax.Array:
        """Return whether the episode ended in the graph's state after a row, bool of shape ``()``."""
        ...


@runtime_checkable
class PrivilegedTask(Protocol):
    """A task with privileged entries: inputs of a value function besides the policy's observation."""

    def privileged(self, graph_state: GraphState) -> jax.Array:
        """Return true quantities of the graph's state, shape ``(P,)``, in any units."""
        ...


@runtime_checkable
class WideningTask(Protocol):
    """A task with a curriculum: its episodes can have a share of their differences."""

    def params_at(self, key: jax.Array, width: jax.Array | None) -> dict[str, PyTree]:
        """Draw the parameters of the nodes for an episode with a share of the differences; None: all of them."""
        ...
