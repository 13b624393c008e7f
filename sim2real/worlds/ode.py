"""Worlds whose dynamics are given as an ordinary differential equation."""

from __future__ import annotations

from abc import abstractmethod
from typing import TypeVar

import jax

from sim2real.types import PyTree
from sim2real.worlds.stepped import SteppedWorld

T = TypeVar("T")


class OdeWorld(SteppedWorld):
    """A world that integrates ``derivative`` with the classical Runge-Kutta method of order four.

    Args:
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float = 0.002, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, substep_s, color=color, order=order)

    @abstractmethod
    def derivative(self, params: PyTree, state: PyTree, command: PyTree) -> PyTree:
        """Return the time derivative of the state.

        Args:
            command: The command, constant during the tick.

        Returns:
            A tree with the structure of ``state`` [the state's units per second].
        """

    def limit(self, params: PyTree, state: PyTree) -> PyTree:
        """Return the state inside its limits; called after every substep."""
        del params
        return state

    def integrate(self, params: PyTree, state: PyTree, command: PyTree) -> PyTree:
        """Return the state one tick later, under a constant command."""

        def substep(x: PyTree, h: float) -> PyTree:
            f = lambda y: self.derivative(params, y, command)  # noqa: E731
            k1 = f(x)
            k2 = f(_axpy(x, k1, h / 2))
            k3 = f(_axpy(x, k2, h / 2))
            k4 = f(_axpy(x, k3, h))
            move = jax.tree_util.tree_map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
            return self.limit(params, _axpy(x, move, h))

        return self.over_substeps(substep, state)


def _axpy(x: T, direction: T, factor: float) -> T:
    """Return ``x + factor * direction``, leaf by leaf."""
    return jax.tree_util.tree_map(lambda a, b: a + factor * b, x, direction)
