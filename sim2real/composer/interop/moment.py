"""What the adapters to other libraries ask of an environment: pure functions of one copy, and what a step returns."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


class Moment(NamedTuple):
    """One copy after a reset or a step.

    Attributes:
        state: The copy's state, a pytree of arrays.
        observation: An array, or a dictionary of arrays.
        reward: Shape ``()``; 0 after a reset.
        terminated: Shape ``()``, bool: the episode ended by itself.
        truncated: Shape ``()``, bool: the episode was cut by a time limit. Never set together with ``terminated``.
        info: Name -> array: what else there is to say of a step.
        ending: Name -> shape ``()``: values of the whole episode; they count only where it ends.
    """

    state: Any
    observation: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, jax.Array]
    ending: dict[str, jax.Array]


class PureEnvironment(Protocol):
    """One copy of an environment, as pure functions that adapters vmap."""

    def reset(self, key: jax.Array) -> Moment:
        """Return a copy at the start of an episode."""
        ...

    def step(self, state: Any, action: jax.Array) -> Moment:
        """Return the copy one step later."""
        ...

    def cut(self, state: Any) -> jax.Array:
        """Return whether the time limit has ended the episode of a state, bool of shape ``()``."""
        ...

    def reseed(self, state: Any, key: jax.Array) -> Any:
        """Return a state whose random numbers go on from ``key`` if it is the start of an episode."""
        ...


def choose(mask: jax.Array, new: T, old: T) -> T:
    """Return ``new`` where ``mask`` is true, else ``old``, for each of N copies.

    Args:
        mask: Shape ``(N,)``, bool.
        new: Leaves of shape ``(N, ...)``.
        old: Like ``new``.
    """

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(pick, new, old)
