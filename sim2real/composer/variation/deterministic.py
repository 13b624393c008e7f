"""Variations without randomness."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from sim2real.arrays import namespace
from sim2real.composer.variation.base import Context, ContextVariation, Parametric, evaluate, is_compiled

if TYPE_CHECKING:
    from sim2real.composer.types import Varying
    from sim2real.types import PyTree


class Constant(Parametric):
    """Always the same value."""

    def __init__(self, value: Varying) -> None:
        self._constant = value

    @property
    def value(self) -> PyTree:
        """The value."""
        return self._constant

    def _value(self, context: Context) -> PyTree:
        return self._constant

    def __str__(self) -> str:
        return f"{self._constant}"

    def __repr__(self) -> str:
        return f"Constant({self._constant!r})"


class Sequence(ContextVariation):
    """One value after the other, cyclically; on MJX, numbers or arrays of one shape."""

    def __init__(self, values: Iterable[Varying]) -> None:
        self._values = values
        self._iterator = iter(values)

    @property
    def values(self) -> Iterable[PyTree]:
        """The values."""
        return self._values

    def _value(self, context: Context) -> PyTree:
        source = context.random_state
        if is_compiled(source):
            position = source.recall(self, 0)
            source.keep(self, position + 1)
            values = namespace(position).asarray(self._values)
            return values[position % len(values)]
        try:
            value = next(self._iterator)
        except StopIteration:
            self._iterator = iter(self._values)
            value = next(self._iterator)
        return evaluate(value, **context._asdict())


class Identity(Parametric):
    """The current value."""

    def _value(self, context: Context) -> PyTree:
        return context.current_value
