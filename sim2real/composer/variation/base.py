"""Values that vary from episode to episode, and arithmetic on them.

A variation is called with ``random_state``: a ``numpy.random.RandomState``, or on MJX an object with the same methods.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sim2real.composer.physics.arrays import is_jax, namespace

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying


def evaluate(structure: Varying, *args: Any, **kwargs: Any) -> Any:
    """Return nested dicts, lists and tuples with every callable in them replaced by what it returns."""
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
    ) -> Any:
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

    def __getitem__(self, index: Any) -> Variation:
        return GetItemOperation(self, index)

    def __neg__(self) -> Variation:
        return UnaryOperation(operator.neg, self)


class UnaryOperation(Variation):
    """An operator applied to a variation."""

    def __init__(self, op: Callable[[Any], Any], variation: Varying) -> None:
        self._op, self._variation = op, variation

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the operator's result."""
        return self._op(evaluate(self._variation, initial_value, current_value, random_state))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UnaryOperation) and (self._op, self._variation) == (other._op, other._variation)

    def __str__(self) -> str:
        return f"{self._op.__name__}({self._variation})"

    def __repr__(self) -> str:
        return f"UnaryOperation({self})"


class BinaryOperation(Variation):
    """An operator applied to two values, at least one of which varies.

    Args:
        op: The operator, a function of two values.
    """

    def __init__(self, op: Callable[[Any, Any], Any], first: Varying, second: Varying) -> None:
        self._op, self._first, self._second = op, first, second

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the operator's result."""
        first = evaluate(self._first, initial_value, current_value, random_state)
        second = evaluate(self._second, initial_value, current_value, random_state)
        return self._op(first, second)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BinaryOperation):
            return False
        return (self._op, self._first, self._second) == (other._op, other._first, other._second)

    def __str__(self) -> str:
        return f"{self._op.__name__}({self._first}, {self._second})"

    def __repr__(self) -> str:
        return f"BinaryOperation({self._op.__name__}({self._first!r}, {self._second!r}))"


class GetItemOperation(Variation):
    """A part of a variation's value."""

    def __init__(self, variation: Varying, index: Any) -> None:
        self._variation, self._index = variation, index

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the part."""
        value = evaluate(self._variation, initial_value, current_value, random_state)
        return (value if is_jax(value) else namespace(value).asarray(value))[self._index]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, GetItemOperation):
            return False
        return (self._variation, self._index) == (other._variation, other._index)

    def __str__(self) -> str:
        return f"{self._variation}[{self._index}]"

    def __repr__(self) -> str:
        return f"GetItemOperation({self._variation!r}[{self._index}])"
