"""Types for annotations in this package; only type checkers import this module.

MuJoCo's compiled modules have no type information about attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np
import numpy.typing as npt
from mujoco._render import MjrContext as MjrContext
from mujoco._specs import MjSpec as MjSpec
from mujoco._structs import MjData as MjData
from mujoco._structs import MjModel as MjModel
from mujoco._structs import MjrRect as MjrRect
from mujoco._structs import MjvOption as MjvOption
from mujoco._structs import MjvScene as MjvScene

Array: TypeAlias = np.ndarray | jax.Array
"""Arrays of an engine: numpy's arrays on C, arrays and tracers of JAX on MJX."""
ArrayLike: TypeAlias = npt.ArrayLike | jax.Array
"""Values from which an array can be made; attributes in MJCF may be texts, too."""


Draw: TypeAlias = Callable[..., Any]
"""A function of a distribution's parameters and ``size`` that draws a number or an array."""


class RandomState(Protocol):
    """A source of randomness: ``numpy.random.RandomState``, the module ``numpy.random``, or a ``JaxRandomState``."""

    def uniform(self, *args: Any, **kwargs: Any) -> Any: ...
    def normal(self, *args: Any, **kwargs: Any) -> Any: ...
    def lognormal(self, *args: Any, **kwargs: Any) -> Any: ...
    def exponential(self, *args: Any, **kwargs: Any) -> Any: ...
    def poisson(self, *args: Any, **kwargs: Any) -> Any: ...
    def binomial(self, *args: Any, **kwargs: Any) -> Any: ...
    def randint(self, *args: Any, **kwargs: Any) -> Any: ...
    def choice(self, *args: Any, **kwargs: Any) -> Any: ...
    def permutation(self, *args: Any, **kwargs: Any) -> Any: ...


class CarriedRandomState(RandomState, Protocol):
    """A ``JaxRandomState``, which carries values of variations from draw to draw."""

    def recall(self, owner: Any, initial: Any) -> jax.Array:
        """Return the value of a variation at its last draw, or its initial value."""
        ...

    def keep(self, owner: Any, value: Any) -> None:
        """Keep a value for the next draw of a variation."""


Varying: TypeAlias = "ArrayLike | Callable[..., Any] | Sequence[Varying] | Mapping[str, Varying] | None"
"""A value, a variation that draws one, or lists and dicts of these; see ``variation.evaluate``."""

Value: TypeAlias = Any
"""The value of an attribute in MJCF or in an ``MjSpec``: a number, a text, an array, an element, or a list of these."""
Index: TypeAlias = Any
"""An index of an array: a number, a slice, an array, or a tuple of these; also names, if rows have names."""
ArrayModule: TypeAlias = Any
"""The module of an engine's arrays: ``numpy`` or ``jax.numpy``."""

Steps: TypeAlias = int | Callable[..., int]
"""A number of physics steps or of samples, or a variation or a function that draws one."""
Aggregate: TypeAlias = Callable[[Any], Any]
"""A reduction of a buffer's first axis, of the arrays of either engine."""
Corrupt: TypeAlias = Callable[..., Any]
"""A function ``corrupt(value, random_state=...)`` of every sample of an observable."""
Hook: TypeAlias = Callable[..., Any]
"""A hook of a task or an entity; its arguments depend on its name."""
