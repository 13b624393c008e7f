"""Variations without randomness."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying


class Constant(Variation):
    """Always the same value."""

    def __init__(self, value: Varying) -> None:
        self._value: Any = value

    @property
    def value(self) -> Any:
        """The value."""
        return self._value

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the value."""
        return self._value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self._value == other._value

    def __str__(self) -> str:
        return f"{self._value}"

    def __repr__(self) -> str:
        return f"Constant({self._value!r})"


class Sequence(Variation):
    """One value after the other, from the start again after the last one; on MJX: of numbers or arrays of one shape."""

    def __init__(self, values: Iterable[Varying]) -> None:
        self._values = values
        self._iterator = iter(values)

    @property
    def values(self) -> Iterable[Any]:
        """The values."""
        return self._values

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: Any = None,
    ) -> Any:
        """Return the next value."""
        if hasattr(random_state, "recall"):
            position = random_state.recall(self, 0)
            random_state.keep(self, position + 1)
            values = namespace(position).asarray(self._values)
            return values[position % len(values)]
        try:
            value = next(self._iterator)
        except StopIteration:
            self._iterator = iter(self._values)
            value = next(self._iterator)
        return evaluate(value, initial_value=initial_value, current_value=current_value, random_state=random_state)


class Identity(Variation):
    """The current value."""

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the current value."""
        return current_value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity)
