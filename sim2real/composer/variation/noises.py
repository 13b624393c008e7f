"""Noise on top of a value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying


class Additive(Variation):
    """Adds a variation to the initial value, or to the current one.

    Args:
        cumulative: Add to the current value rather than to the initial one.
    """

    def __init__(self, variation: Varying, cumulative: bool = False) -> None:
        self._variation, self._cumulative = variation, cumulative

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the sum."""
        base: Any = current_value if self._cumulative else initial_value
        return base + evaluate(self._variation, initial_value, current_value, random_state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Additive):
            return False
        return (self._variation, self._cumulative) == (other._variation, other._cumulative)

    def __repr__(self) -> str:
        return f"Additive(variation={self._variation}, cumulative={self._cumulative})"


class Multiplicative(Variation):
    """Multiplies the initial value, or the current one, by a variation.

    Args:
        variation: The factor.
        cumulative: Multiply the current value rather than the initial one.
    """

    def __init__(self, variation: Varying, cumulative: bool = False) -> None:
        self._variation, self._cumulative = variation, cumulative

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the product."""
        base: Any = current_value if self._cumulative else initial_value
        return base * evaluate(self._variation, initial_value, current_value, random_state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Multiplicative):
            return False
        return (self._variation, self._cumulative) == (other._variation, other._cumulative)

    def __repr__(self) -> str:
        return f"Multiplicative(variation={self._variation}, cumulative={self._cumulative})"
