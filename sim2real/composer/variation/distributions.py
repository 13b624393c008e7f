"""Random variations. Samples have the shape of the initial value, unless ``single_sample``."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from typing import TYPE_CHECKING

from sim2real.arrays import namespace
from sim2real.composer.variation.base import Context, ContextVariation, Parametric, evaluate, is_compiled
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import Draw, RandomState, Varying
    from sim2real.types import PyTree


class Distribution(Parametric):
    """A distribution whose parameters may be variations; parameters can be read as attributes.

    Args:
        single_sample: Whether to draw one sample for an initial value of any shape.
    """

    def __init__(self, *args: Varying, single_sample: bool = False, **kwargs: Varying) -> None:
        self._args, self._kwargs, self._single_sample = args, kwargs, single_sample

    def _value(self, context: Context) -> PyTree:
        options = context._asdict()
        size = context.shape(self._single_sample)
        args, kwargs = evaluate(self._args, **options), evaluate(self._kwargs, **options)
        return self._callable(context.source)(*args, size=size, **kwargs)

    @property
    def parameters(self) -> tuple[PyTree, ...]:
        """The parameters, positional ones first."""
        return (*self._args, *self._kwargs.values())

    def __getattr__(self, name: str) -> PyTree:
        if not name.startswith("_") and name in self._kwargs:
            return self._kwargs[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _callable(self, random_state: RandomState) -> Draw:
        """Return the function that samples, given the parameters and ``size``."""


class Uniform(Distribution):
    """Uniform in ``[low, high)``."""

    def __init__(self, low: Varying = 0.0, high: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(low=low, high=high, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.uniform


class UniformInteger(Distribution):
    """Integers in ``[low, high)``, or in ``[0, low)`` without ``high``."""

    def __init__(self, low: Varying, high: Varying = None, single_sample: bool = False) -> None:
        super().__init__(low, high=high, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.randint


class UniformChoice(Distribution):
    """One of some values."""

    def __init__(self, choices: Varying, single_sample: bool = False) -> None:
        super().__init__(choices, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.choice


class UniformPointOnSphere(Parametric):
    """A vector of length 1 in a random direction."""

    def __init__(self, single_sample: bool = False) -> None:
        self._single_sample = single_sample

    def _value(self, context: Context) -> PyTree:
        axis = context.source.normal(size=(*(context.shape(self._single_sample) or ()), 3))
        return axis / namespace(axis).linalg.norm(axis, axis=-1, keepdims=True)


class Normal(Distribution):
    """Normal with mean ``loc`` and standard deviation ``scale``."""

    def __init__(self, loc: Varying = 0.0, scale: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(loc=loc, scale=scale, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.normal


class LogNormal(Distribution):
    """The exponential of a normal variable."""

    def __init__(self, mean: Varying = 0.0, sigma: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(mean=mean, sigma=sigma, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.lognormal


class Exponential(Distribution):
    """Exponential with mean ``scale``."""

    def __init__(self, scale: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(scale=scale, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.exponential


class Poisson(Distribution):
    """Poisson with mean ``lam``."""

    def __init__(self, lam: Varying = 1.0, single_sample: bool = False) -> None:
        super().__init__(lam=lam, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return random_state.poisson


class Bernoulli(Distribution):
    """1 with probability ``prob``, else 0."""

    def __init__(self, prob: Varying = 0.5, single_sample: bool = False) -> None:
        super().__init__(prob, single_sample=single_sample)

    def _callable(self, random_state: RandomState) -> Draw:
        return functools.partial(random_state.binomial, 1)


class BiasedRandomWalk(ContextVariation):
    """A zero-mean Ornstein-Uhlenbeck process, one step per call; it continues in the next episode, except on MJX.

    Args:
        timescale: Number of calls after which the correlation has fallen to 1/e; 0: uncorrelated.

    Raises:
        UsageError: An argument is negative.
    """

    def __init__(self, stdev: float = 0.1, timescale: float = 10.0) -> None:
        if stdev < 0:
            raise UsageError(f"`stdev` must be >= 0, got {stdev}.")
        if timescale < 0:
            raise UsageError(f"`timescale` must be >= 0, got {timescale}.")
        self._retain = math.exp(-1.0 / timescale) if timescale else 0.0
        self._scale = stdev * math.sqrt(1.0 - self._retain**2)
        self._position: PyTree = 0.0

    def _value(self, context: Context) -> PyTree:
        source = context.source
        noise = source.normal(loc=0.0, scale=self._scale)
        if is_compiled(source):
            position = self._retain * source.recall(self, 0.0) + noise
            source.keep(self, position)
            return position
        self._position = self._retain * self._position + noise
        return self._position

    def __repr__(self) -> str:
        return f"BiasedRandomWalk(id={id(self)}, scale={self._scale}, retain={self._retain}, value={self._position})"
