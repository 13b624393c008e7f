"""Functions of variations."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Context, Parametric, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayModule, Draw, Varying
    from sim2real.types import PyTree


class MathOp(Parametric):
    """A function of values that may vary; arguments are those of the numpy function."""

    def __init__(self, *args: Varying, **kwargs: Varying) -> None:
        self._args, self._kwargs = args, kwargs

    def _value(self, context: Context) -> PyTree:
        options = context._asdict()
        args, kwargs = evaluate(self._args, **options), evaluate(self._kwargs, **options)
        return self._function(namespace(*args))(*args, **kwargs)

    @abstractmethod
    def _function(self, xp: ArrayModule) -> Draw:
        """Return the function, from numpy or ``jax.numpy``."""


class Log(MathOp):
    """The natural logarithm."""

    def _function(self, xp: ArrayModule) -> Draw:
        return xp.log


class Max(MathOp):
    """The largest entry."""

    def _function(self, xp: ArrayModule) -> Draw:
        return xp.max


class Min(MathOp):
    """The smallest entry."""

    def _function(self, xp: ArrayModule) -> Draw:
        return xp.min


class Norm(MathOp):
    """The norm of a vector."""

    def _function(self, xp: ArrayModule) -> Draw:
        return xp.linalg.norm
