"""Functions of variations."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, Draw, RandomState, Varying


class MathOp(Variation):
    """A function of values that may vary; arguments are those of the numpy function."""

    def __init__(self, *args: Varying, **kwargs: Varying) -> None:
        self._args, self._kwargs = args, kwargs

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the function's value."""
        given = {"initial_value": initial_value, "current_value": current_value, "random_state": random_state}
        args, kwargs = evaluate(self._args, **given), evaluate(self._kwargs, **given)
        return self._function(namespace(*args))(*args, **kwargs)

    @abstractmethod
    def _function(self, xp: Any) -> Draw:
        """Return the function, from numpy or ``jax.numpy``."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        return (self._args, self._kwargs) == (other._args, other._kwargs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(args={self._args}, kwargs={self._kwargs})"


class Log(MathOp):
    """The natural logarithm."""

    def _function(self, xp: Any) -> Draw:
        return xp.log


class Max(MathOp):
    """The largest entry."""

    def _function(self, xp: Any) -> Draw:
        return xp.max


class Min(MathOp):
    """The smallest entry."""

    def _function(self, xp: Any) -> Draw:
        return xp.min


class Norm(MathOp):
    """The norm of a vector."""

    def _function(self, xp: Any) -> Draw:
        return xp.linalg.norm
