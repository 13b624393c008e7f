"""Randomness inside a compiled program, with the methods of ``numpy.random.RandomState``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from sim2real.composer.variation.base import Variation


Size = int | Sequence[int] | None
"""The shape of a draw; None: the shape of the parameters."""


class Registry:
    """The values that variations keep from draw to draw, such as the position of a random walk.

    Attributes:
        initial: Name -> value at the start of an episode.
    """

    def __init__(self) -> None:
        self.initial: dict[str, ArrayLike] = {}
        self._owners: list[Variation] = []

    def name(self, owner: Variation, initial: ArrayLike) -> str:
        """Return the name of an owner's value."""
        number = next((i for i, other in enumerate(self._owners) if other is owner), None)
        if number is None:
            number = len(self._owners)
            self._owners.append(owner)
        name = f"{type(owner).__name__}_{number}"
        self.initial.setdefault(name, initial)
        return name


class JaxRandomState:
    """Draws like a ``RandomState``, by methods with the same arguments, from a JAX key that it splits at every draw.

    Args:
        memory: Values that variations keep from draw to draw: name -> array.

    Attributes:
        memory: This dictionary, with new values.
    """

    def __init__(
        self, key: jax.Array | None, memory: dict[str, jax.Array] | None = None, registry: Registry | None = None
    ) -> None:
        self.key: Any = key
        self.memory = {} if memory is None else memory
        self._registry = registry or Registry()

    def recall(self, owner: Variation, initial: ArrayLike) -> jax.Array:
        """Return the value of a variation at its last draw, or its initial value."""
        name = self._registry.name(owner, initial)
        return self.memory[name] if name in self.memory else jnp.asarray(initial)

    def keep(self, owner: Variation, value: ArrayLike) -> None:
        """Keep a value for the next draw of a variation."""
        name = self._registry.name(owner, value)
        self.memory[name] = jnp.asarray(value, jnp.asarray(self._registry.initial[name]).dtype)

    def next_key(self) -> jax.Array:
        """Return a key that was not used before."""
        self.key, key = jax.random.split(self.key)
        return key

    def uniform(self, low: ArrayLike = 0.0, high: ArrayLike = 1.0, size: Size = None) -> jax.Array:
        low, high = jnp.asarray(low, float), jnp.asarray(high, float)
        return low + (high - low) * jax.random.uniform(self.next_key(), _shape(size, low, high))

    def normal(self, loc: ArrayLike = 0.0, scale: ArrayLike = 1.0, size: Size = None) -> jax.Array:
        loc, scale = jnp.asarray(loc, float), jnp.asarray(scale, float)
        return loc + scale * jax.random.normal(self.next_key(), _shape(size, loc, scale))

    def lognormal(self, mean: ArrayLike = 0.0, sigma: ArrayLike = 1.0, size: Size = None) -> jax.Array:
        return jnp.exp(self.normal(mean, sigma, size))

    def exponential(self, scale: ArrayLike = 1.0, size: Size = None) -> jax.Array:
        return jnp.asarray(scale, float) * jax.random.exponential(self.next_key(), _shape(size, scale))

    def poisson(self, lam: ArrayLike = 1.0, size: Size = None) -> jax.Array:
        # JAX draws Poisson numbers only with threefry keys.
        key = jax.random.wrap_key_data(jax.random.key_data(self.next_key()), impl="threefry2x32")
        return jax.random.poisson(key, lam, _shape(size, lam))

    def binomial(self, n: ArrayLike, p: ArrayLike, size: Size = None) -> jax.Array:
        return jax.random.binomial(self.next_key(), n, p, _shape(size, n, p)).astype(int)

    def randint(self, low: ArrayLike, high: ArrayLike | None = None, size: Size = None) -> jax.Array:
        low, high = (0, low) if high is None else (low, high)
        return jax.random.randint(self.next_key(), _shape(size, low, high), low, high)

    def choice(self, a: ArrayLike, size: Size = None, replace: bool = True, p: ArrayLike | None = None) -> jax.Array:
        values = jnp.arange(a) if np.ndim(a) == 0 else jnp.asarray(a)
        return jax.random.choice(self.next_key(), values, _shape(size), replace, None if p is None else jnp.asarray(p))

    def permutation(self, x: ArrayLike) -> jax.Array:
        return jax.random.permutation(self.next_key(), x)

    def random_sample(self, size: Size = None) -> jax.Array:
        return self.uniform(size=size)

    def standard_normal(self, size: Size = None) -> jax.Array:
        return self.normal(size=size)

    def beta(self, a: ArrayLike, b: ArrayLike, size: Size = None) -> jax.Array:
        return jax.random.beta(self.next_key(), a, b, _shape(size, a, b))

    def gamma(self, shape: ArrayLike, scale: ArrayLike = 1.0, size: Size = None) -> Any:
        return scale * jax.random.gamma(self.next_key(), shape, _shape(size, shape, scale))

    def shuffle(self, x: ArrayLike) -> None:
        """Raise a UsageError: on MJX arrays cannot be changed in place."""
        raise UsageError("random_state.shuffle works in place", hint="use x = random_state.permutation(x)")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        available = ", ".join(n for n in dir(type(self)) if not n.startswith("_"))
        raise AttributeError(f"on MJX random_state has no {name!r}. Available: {available}")

    def rand(self, *shape: int) -> jax.Array:
        return self.uniform(size=shape)

    def randn(self, *shape: int) -> jax.Array:
        return self.normal(size=shape)


def _shape(size: Any, *parameters: ArrayLike) -> tuple[int, ...]:
    if size is None:
        return jnp.broadcast_shapes(*(jnp.shape(p) for p in parameters)) if parameters else ()
    return (int(size),) if np.ndim(size) == 0 else tuple(int(s) for s in size)
