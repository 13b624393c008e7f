"""Random variations. Samples have the shape of the initial value, unless ``single_sample``."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Variation, evaluate
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, Draw, RandomState, Varying


class Distribution(Variation):
    """A distribution whose parameters may vary themselves; they can be read as attributes.

    Args:
        single_sample: Draw one sample, whatever the shape of the initial value.
    """

    __slots__ = ("_args", "_kwargs", "_single_sample")

    def __init__(self, *args: Varying, single_sample: bool = False, **kwargs: Varying) -> None:
        self._single_sample, self._args, self._kwargs = single_sample, args, kwargs

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a sample."""
        given = {"initial_value": initial_value, "current_value": current_value, "random_state": random_state}
        size = None if self._single_sample or initial_value is None else np.shape(initial_value)
        args, kwargs = evaluate(self._args, **given), evaluate(self._kwargs, **given)
        return self._callable(random_state or np.random)(*args, size=size, **kwargs)

    @property
    def parameters(self) -> tuple[Any, ...]:
        """The parameters, those without a name first."""
        return (*self._args, *self._kwargs.values())

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("_") and name in self._kwargs:
            return self._kwargs[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _callable(self, random_state: RandomState) -> Draw:
        """Return the function that samples, given the parameters and ``size``."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        mine = (self._args, self._kwargs, self._single_sample)
        return mine == (other._args, other._kwargs, other._single_sample)

    def __repr__(self) -> str:
        name = type(self).__name__
        return f"{name}(args={self._args}, kwargs={self._kwargs}, single_sample={self._single_sample})"


class Uniform(Distribution):
    """Uniform in ``[low, high)``.

    Args:
        single_sample: Draw one sample, whatever the shape of the initial value.
    """

    __slots__ = ()

    def __init__(self, low: Varying = 0.0, high: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(low=low, high=high, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.uniform


class UniformInteger(Distribution):
    """Integers in ``[low, high)``, or in ``[0, low)`` without ``high``.

    Args:
        low: The lower bound; without ``high``, the upper one.
        single_sample: Draw one sample, whatever the shape of the initial value.
    """

    __slots__ = ()

    def __init__(self, low: Varying, high: Varying = None, single_sample: bool = False) -> None:
        super().__init__(low, high=high, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.randint


class UniformChoice(Distribution):
    """One of some values."""

    __slots__ = ()

    def __init__(self, choices: Varying, single_sample: bool = False) -> None:
        super().__init__(choices, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.choice


class UniformPointOnSphere(Variation):
    """A vector of length 1 in a random direction."""

    def __init__(self, single_sample: bool = False) -> None:
        self._single_sample = single_sample

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a vector, shape ``(3,)``, or one for each entry of the initial value."""
        random_state = random_state or np.random
        shape: tuple[int, ...] = () if self._single_sample or initial_value is None else np.shape(initial_value)
        axis = random_state.normal(size=(*shape, 3))
        return axis / namespace(axis).linalg.norm(axis, axis=-1, keepdims=True)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UniformPointOnSphere) and self._single_sample == other._single_sample

    def __repr__(self) -> str:
        return f"UniformPointOnSphere(single_sample={self._single_sample})"


class Normal(Distribution):
    """Normal with mean ``loc`` and standard deviation ``scale``.

    Args:
        single_sample: Draw one sample, whatever the shape of the initial value.
    """

    __slots__ = ()

    def __init__(self, loc: Varying = 0.0, scale: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(loc=loc, scale=scale, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.normal


class LogNormal(Distribution):
    """The exponential of a normal variable.

    Args:
        single_sample: Draw one sample, whatever the shape of the initial value.
    """

    __slots__ = ()

    def __init__(self, mean: Varying = 0.0, sigma: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(mean=mean, sigma=sigma, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.lognormal


class Exponential(Distribution):
    """Exponential with mean ``scale``."""

    __slots__ = ()

    def __init__(self, scale: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(scale=scale, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.exponential


class Poisson(Distribution):
    """Poisson with mean ``lam``."""

    __slots__ = ()

    def __init__(self, lam: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(lam=lam, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.poisson


class Bernoulli(Distribution):
    """1 with probability ``prob``, else 0."""

    __slots__ = ()

    def __init__(self, prob: Varying = 0.5, single_sample: bool = False) -> None:
        super().__init__(prob, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return functools.partial(random_state.binomial, 1)


class BiasedRandomWalk(Variation):
    """A zero-mean Ornstein-Uhlenbeck process, one step a call; it goes on from episode to episode, but not on MJX.

    Args:
        timescale: Calls after which the correlation has fallen to 1/e; 0: uncorrelated.

    Raises:
        UsageError: When one of them is negative.
    """

    def __init__(self, stdev: float = 0.1, timescale: float = 10.0) -> None:
        if stdev < 0:
            raise UsageError(f"`stdev` must be >= 0, got {stdev}.")
        if timescale < 0:
            raise UsageError(f"`timescale` must be >= 0, got {timescale}.")
        self._retain = math.exp(-1.0 / timescale) if timescale else 0.0
        self._scale = stdev * math.sqrt(1.0 - self._retain**2)
        self._value: Any = 0.0

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: Any = None,
    ) -> Any:
        """Return the next value."""
        random_state = random_state or np.random
        if hasattr(random_state, "recall"):
            value = self._retain * random_state.recall(self, 0.0) + random_state.normal(loc=0.0, scale=self._scale)
            random_state.keep(self, value)
            return value
        self._value = self._retain * self._value + random_state.normal(loc=0.0, scale=self._scale)
        return self._value

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = object.__hash__

    def __repr__(self) -> str:
        return f"BiasedRandomWalk(id={id(self)}, scale={self._scale}, retain={self._retain}, value={self._value})"
