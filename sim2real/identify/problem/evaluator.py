"""Evaluation of a problem's residuals: by compiled programs, or on C MuJoCo between two programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from sim2real.identify.problem.programs import OnCompile
from sim2real.identify.problem.residuals import LinearisedSegments, SegmentResiduals
from sim2real.identify.problem.robust import tamed
from sim2real.identify.problem.segments import Data
from sim2real.identify.problem.sizes import padded
from sim2real.later import jax, jnp
from sim2real.types import Array, PyTree

_COMPARED = 16
"""Candidates in a call of the program of losses, or a multiple of it."""
Stacked = Callable[[np.ndarray], np.ndarray]


class Evaluator(Protocol):
    """Evaluates residuals; arrays are padded like ``Data``.

    Attributes:
        precision: Relative change of the loss below which rounding or the noise of finite differences dominates.
        fresh: Whether ``around`` linearises initial states at every point.
    """

    precision: float
    fresh: bool

    def linearised(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> LinearisedSegments:
        """Return the residuals of the fitted segments and their derivatives at ``z (P,)``."""
        ...

    def loss(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> float:
        """Return the loss at ``z (P,)``, with initial states linearised there."""
        ...

    def around(self, z: np.ndarray, data: Data) -> tuple[Stacked, Stacked]:
        """Return functions of points ``(P,)`` near ``z`` for a descent.

        Returns:
            The first returns the robust residuals ``(N,)``, then those of the priors; the second returns their
            Jacobian ``(N, P)``.
        """
        ...

    def losses(self, candidates: np.ndarray, around: np.ndarray, data: Data) -> np.ndarray:
        """Return the loss of each candidate, ``(N,)``, with initial states linearised at one point.

        Args:
            candidates: Shape ``(N, P)``.
            around: Shape ``(P,)``.
        """
        ...

    def searched(self, data: Data) -> PyTree:
        """Return the losses of generations, as ``search`` takes them."""
        ...

    def lively(self, data: Data, most: int | None = None) -> Data:
        """Return the data with the segments in which the channels move most.

        Args:
            most: Number of segments; default: as many as suffice for a start.
        """
        ...

    def predict(self, values: Any, eps: np.ndarray, fit_s: np.ndarray, data: Data) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals ``(R, K, F)`` of segments with fitted initial states, and these ``(R, 2 * channels)``.

        Args:
            values: Parameters by name, ``(R, ...)``.
            eps: Shape ``(R,)``: numbers of the segments.
            fit_s: Shape ``(R,)``: lengths of the first parts, to which initial states are fitted [s].
        """
        ...

    def with_values(self, z: np.ndarray, rows: np.ndarray, data: Data) -> np.ndarray:
        """Return the robust residuals ``(G, S, K, F)`` with some parameters set.

        Args:
            z: Shape ``(P,)``: initial states are linearised there.
            rows: Shape ``(G, P)``: values of the parameters that are set; NaN keeps the value at ``z``.
        """
        ...


class CompiledEvaluator:
    """Evaluates the residuals by programs that contain the rollouts."""

    precision, fresh = 1e-6, True

    def __init__(self, residuals: SegmentResiduals) -> None:
        self._residuals = residuals
        self._last: tuple[bytes, Data, LinearisedSegments] | None = None

    def linearised(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> LinearisedSegments:
        """See ``Evaluator``; the last point is cached, as descents need value, derivative and loss in turn."""
        point = np.asarray(z, np.float32)
        if self._last is None or self._last[0] != point.tobytes() or self._last[1] is not data:
            program = self._residuals.program("linearised", self._residuals.linearised)
            self._last = point.tobytes(), data, program(point, data, on_compile=on_compile)
        return self._last[2]

    def loss(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> float:
        """See ``Evaluator``."""
        return float(self.linearised(z, data, on_compile).loss)

    def around(self, z: np.ndarray, data: Data) -> tuple[Stacked, Stacked]:
        """See ``Evaluator``: initial states are linearised at every point."""
        return lambda y: stacked(self.linearised(y, data))[0], lambda y: stacked(self.linearised(y, data))[1]

    def losses(self, candidates: np.ndarray, around: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        program = self._residuals.program("losses", self._residuals.losses)
        # Pad the candidates: each number of them compiles once.
        points = padded(candidates, -(-len(candidates) // _COMPARED) * _COMPARED)
        return np.asarray(program(single(points), single(around), data), np.float64)[: len(candidates)]

    def searched(self, data: Data) -> PyTree:
        """See ``Evaluator``."""
        return lambda candidates, middle, new: self.losses(candidates, middle, data)

    def lively(self, data: Data, most: int | None = None) -> Data:
        """See ``Evaluator``: all, as a program simulates the segments without weight, too."""
        return data

    def predict(self, values: Any, eps: np.ndarray, fit_s: np.ndarray, data: Data) -> tuple[np.ndarray, np.ndarray]:
        """See ``Evaluator``."""
        many = jax.vmap(self._residuals.predict, in_axes=(0, 0, 0, None))
        program = self._residuals.program("predict", many)
        arrays = {n: single(v) for n, v in values.items()}
        residuals, starts = program(arrays, jnp.asarray(eps, jnp.int32), single(fit_s), data)
        return np.asarray(residuals, np.float64), np.asarray(starts, np.float64)

    def with_values(self, z: np.ndarray, rows: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        program = self._residuals.program("with_values", self._with_values)
        return np.asarray(program(single(z), single(rows), data), np.float64)

    def _with_values(self, z: Array, rows: Array, data: Data) -> PyTree:
        residuals = self._residuals
        states = residuals.initial_states(z, data, data.fitted)

        def one(row: Array) -> PyTree:
            values = replaced(residuals, z, row)
            r = jax.vmap(lambda e, s: residuals.projected(values, e, s, data))(data.fitted, states)
            return tamed(r, residuals.config.loss, residuals.config.reach)

        return jax.vmap(one)(rows)


def replaced(residuals: SegmentResiduals, z: Array, row: Array) -> dict[str, PyTree]:
    """Return parameters by name at a point, with some of them set; traceable.

    Args:
        z: Shape ``(P,)``: the point.
        row: Shape ``(P,)``: values of the parameters that are set; NaN keeps the value at ``z``.
    """
    values = residuals.table.decode(z)
    for i, c in enumerate(residuals.table.columns):
        if c.recording is None:
            values[c.label] = jnp.where(jnp.isnan(row[i]), values[c.label], row[i])
    return values


def stacked(at: LinearisedSegments) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals ``(N,)`` and Jacobian ``(N, P)``, followed by those of the priors."""
    r, J, prior, slope = (np.asarray(a, np.float64) for a in (at.residuals, at.jacobian, at.prior, at.prior_jacobian))
    return np.concatenate([r.reshape(-1), prior]), np.concatenate([J.reshape(-1, J.shape[-1]), slope])


def single(a: Any) -> jax.Array:
    """Return an array of single precision."""
    return jnp.asarray(np.asarray(a), jnp.float32)
