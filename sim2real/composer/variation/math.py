"""Functions of variations."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from sim2real.composer.arrays import namespace
from sim2real.composer.variation.base import Variation, evaluate


class MathOp(Variation):
    """A function of values that may vary; arguments are those of the numpy function."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._args, self._kwargs = args, kwargs

    def __call__(self, initial_value: Any = None, current_value: Any = None, random_state: Any = None) -> Any:
        """Return the function's value."""
        given = {"initial_value": initial_value, "current_value": current_value, "random_state": random_state}
        args, kwargs = evaluate(self._args, **given), evaluate(self._kwargs, **given)
        return self._function(namespace(*args))(*args, **kwargs)

    @abstractmethod
    def _function(self, xp: Any) -> Callable[..., Any]:
        """Return the function, from numpy or ``jax.numpy``."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        return (self._args, self._kwargs) == (other._args, other._kwargs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(args={self._args}, kwargs={self._kwargs})"


class Log(MathOp):
    """The natural logarithm."""

    def _function(self, xp: Any) -> Callable[..., Any]:
        return xp.log


class Max(MathOp):
    """The largest entry."""

    def _function(self, xp: Any) -> Callable[..., Any]:
        return xp.max


class Min(MathOp):
    """The smallest entry."""

    def _function(self, xp: Any) -> Callable[..., Any]:
        return xp.min


class Norm(MathOp):
    """The norm of a vector."""

    def _function(self, xp: Any) -> Callable[..., Any]:
        return xp.linalg.norm
