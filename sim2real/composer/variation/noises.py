"""Noise that is added to, or multiplied with, a value."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.composer.variation.base import Context, Parametric, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import Varying
    from sim2real.types import PyTree


class Additive(Parametric):
    """Adds a variation to the initial value, or to the current one."""

    def __init__(self, variation: Varying, cumulative: bool = False) -> None:
        self._variation, self._cumulative = variation, cumulative

    def _value(self, context: Context) -> PyTree:
        return context.base(self._cumulative) + evaluate(self._variation, *context)


class Multiplicative(Parametric):
    """Multiplies the initial value, or the current one, by a variation."""

    def __init__(self, variation: Varying, cumulative: bool = False) -> None:
        self._variation, self._cumulative = variation, cumulative

    def _value(self, context: Context) -> PyTree:
        return context.base(self._cumulative) * evaluate(self._variation, *context)
