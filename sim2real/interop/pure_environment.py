"""The environment that the adapters to other libraries take: pure functions of one copy, and what a step returns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

import jax
from dm_env import specs

if TYPE_CHECKING:
    from sim2real.types import Key, PyTree

S = TypeVar("S")


class Transition(NamedTuple, Generic[S]):
    """One copy after a reset or a step.

    Attributes:
        state: A pytree of arrays.
        observation: An array, or a dictionary of arrays.
        reward: Shape ``()``; 0 after a reset.
        terminated: Shape ``()``, bool: the task ended the episode.
        truncated: Shape ``()``, bool: a time limit ended the episode. Never true together with ``terminated``.
        info: Name -> array: further values of the step.
        episode_values: Name -> shape ``()``: values of the whole episode, valid only in its last step.
    """

    state: S
    observation: PyTree
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, jax.Array]
    episode_values: dict[str, jax.Array]


class PureEnvironment(Protocol[S]):
    """One copy of an environment, as pure functions; the adapters apply ``vmap``."""

    @property
    def observation_spec(self) -> specs.Array | Mapping[str, specs.Array]:
        """Shapes, dtypes and bounds of an observation."""
        ...

    @property
    def action_spec(self) -> specs.Array:
        """Shape, dtype and bounds of an action."""
        ...

    @property
    def period_s(self) -> float:
        """Time between two actions [s]."""
        ...

    @property
    def length(self) -> int | None:
        """Largest number of steps of an episode; None: no time limit."""
        ...

    def reset(self, key: Key) -> Transition[S]:
        """Return a copy at the start of an episode."""
        ...

    def step(self, state: S, action: jax.Array) -> Transition[S]:
        """Return the copy one step later."""
        ...

    def is_truncated(self, state: S) -> jax.Array:
        """Return whether the time limit has ended the episode of a state, bool of shape ``()``."""
        ...

    def reseed(self, state: S, key: Key) -> S:
        """Return the start of an episode with random numbers from ``key``; any other state may stay as it is."""
        ...
