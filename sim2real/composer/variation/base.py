"""Values that vary from episode to episode, and arithmetic on them.

A variation is called with ``random_state``: a ``numpy.random.RandomState``, or on MJX an object with the same methods.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeGuard

import numpy as np

from sim2real.arrays import is_jax, namespace

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, CarriedRandomState, Index, RandomState, Varying
    from sim2real.types import PyTree


def evaluate(structure: Varying, *args: PyTree, **kwargs: PyTree) -> PyTree:
    """Return nested dicts, lists and tuples with every callable in them replaced by its result."""
    if isinstance(structure, dict):
        return type(structure)((k, evaluate(v, *args, **kwargs)) for k, v in structure.items())
    if isinstance(structure, tuple) and hasattr(structure, "_fields"):
        return type(structure)(*(evaluate(v, *args, **kwargs) for v in structure))
    if isinstance(structure, list | tuple):
        return type(structure)(evaluate(v, *args, **kwargs) for v in structure)
    return structure(*args, **kwargs) if callable(structure) else structure


class Variation(ABC):
    """A value that varies; ``+ - * / // ** -`` and ``[]`` make new variations."""

    @abstractmethod
    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> PyTree:
        """Return a value."""

    def __add__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.add, self, other)

    def __radd__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.add, other, self)

    def __sub__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.sub, self, other)

    def __rsub__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.sub, other, self)

    def __mul__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.mul, self, other)

    def __rmul__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.mul, other, self)

    def __truediv__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.truediv, self, other)

    def __rtruediv__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.truediv, other, self)

    def __floordiv__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.floordiv, self, other)

    def __rfloordiv__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.floordiv, other, self)

    def __pow__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.pow, self, other)

    def __rpow__(self, other: Varying) -> Variation:
        return BinaryOperation(operator.pow, other, self)

    def __getitem__(self, index: Index) -> Variation:
        return GetItemOperation(self, index)

    def __neg__(self) -> Variation:
        return UnaryOperation(operator.neg, self)


def is_compiled(random_state: RandomState | None) -> TypeGuard[CarriedRandomState]:
    """Return whether random numbers are drawn inside a compiled program, which carries values from draw to draw."""
    return hasattr(random_state, "recall")


class Context(NamedTuple):
    """Arguments of a variation.

    Attributes:
        initial_value: The value before the first variation.
        current_value: The value now.
        random_state: Source of random numbers; None: numpy's global one.
    """

    initial_value: PyTree
    current_value: PyTree
    random_state: RandomState | None

    @property
    def source(self) -> RandomState:
        """The source of random numbers."""
        return self.random_state or np.random

    def shape(self, single_sample: bool) -> tuple[int, ...] | None:
        """Return the shape of the initial value; None for a single sample."""
        return None if single_sample or self.initial_value is None else np.shape(self.initial_value)

    def base(self, cumulative: bool) -> PyTree:
        """Return the value that a variation changes: the current one, or the initial one."""
        return self.current_value if cumulative else self.initial_value


class ContextVariation(Variation):
    """A variation whose subclasses compute the value in ``_value``."""

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> PyTree:
        """Return a value."""
        return self._value(Context(initial_value, current_value, random_state))

    @abstractmethod
    def _value(self, context: Context) -> PyTree:
        """Return a value."""


class Parametric(ContextVariation):
    """A variation that equals another one if classes and parameters are equal."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and [*vars(self).values()] == [*vars(other).values()]

    def __repr__(self) -> str:
        parameters = ", ".join(f"{name.removeprefix('_')}={value}" for name, value in vars(self).items())
        return f"{type(self).__name__}({parameters})"


class UnaryOperation(Parametric):
    """An operator applied to a variation."""

    def __init__(self, op: Callable[[PyTree], PyTree], variation: Varying) -> None:
        self._op, self._variation = op, variation

    def _value(self, context: Context) -> PyTree:
        return self._op(evaluate(self._variation, *context))

    def __str__(self) -> str:
        return f"{self._op.__name__}({self._variation})"

    def __repr__(self) -> str:
        return f"UnaryOperation({self})"


class BinaryOperation(Parametric):
    """An operator applied to two values; at least one of them varies."""

    def __init__(self, op: Callable[[PyTree, PyTree], PyTree], first: Varying, second: Varying) -> None:
        self._op, self._first, self._second = op, first, second

    def _value(self, context: Context) -> PyTree:
        return self._op(evaluate(self._first, *context), evaluate(self._second, *context))

    def __str__(self) -> str:
        return f"{self._op.__name__}({self._first}, {self._second})"

    def __repr__(self) -> str:
        return f"BinaryOperation({self._op.__name__}({self._first!r}, {self._second!r}))"


class GetItemOperation(Parametric):
    """A part of a variation's value."""

    def __init__(self, variation: Varying, index: Index) -> None:
        self._variation, self._index = variation, index

    def _value(self, context: Context) -> PyTree:
        value = evaluate(self._variation, *context)
        return (value if is_jax(value) else namespace(value).asarray(value))[self._index]

    def __str__(self) -> str:
        return f"{self._variation}[{self._index}]"

    def __repr__(self) -> str:
        return f"GetItemOperation({self._variation!r}[{self._index}])"
