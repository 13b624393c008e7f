"""Profiles: the increase of the loss along one parameter, with the others fitted to the linearised residuals."""

from dataclasses import dataclass

import numpy as np

from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.uncertainty import Linearised, Uncertainty, loss_variance

ONE_SIDED = 1.645
"""One-sided 95 % quantile of a normal distribution; its square is the increase of the loss at a bound."""
_VALUES = 12


@dataclass(frozen=True)
class Profile:
    """Increase of the loss along one parameter, with the others fitted.

    Attributes:
        values: Shape ``(V,)``, from the value without effect on: ascending, of a limit descending.
        worse: Shape ``(V,)``: sum of squares over its variance, above the smallest; 1 is one standard deviation.
        moves: Shape ``(V, P)``: steps of the others, on their scales.
        residuals: Shape ``(V, N)``: without these steps.
    """

    values: np.ndarray
    worse: np.ndarray
    moves: np.ndarray
    residuals: np.ndarray

    def last(self) -> int | None:
        """Return the number of the last value in a one-sided interval of 95 %; None without a bound."""
        good = np.flatnonzero(self.worse <= ONE_SIDED**2)
        return int(good[-1]) if len(good) and good[-1] + 1 < len(self.values) else None

    def bound(self) -> float | None:
        """Return the end of a one-sided interval of 95 %; None if the data does not bound the parameter."""
        if (a := self.last()) is None:
            return None
        # The square root grows like the value itself, as in a linear model; of a limit, from where it acts on.
        limit = self.values[0] > self.values[-1] and np.isfinite(self.worse[a + 1 : a + 3]).sum() == 2
        (near, far), (low, high) = (column[[a + limit, a + limit + 1]] for column in (self.values, np.sqrt(self.worse)))
        return float(np.clip(near + (ONE_SIDED - low) / (high - low) * (far - near), *sorted(self.values[[a, a + 1]])))

    def moved(self, value: float) -> np.ndarray:
        """Return the steps of the others at a value, ``(P,)``."""
        sign = np.sign(self.values[-1] - self.values[0])
        return np.array([np.interp(sign * value, sign * self.values, column) for column in self.moves.T])

    def effect(self, value: float) -> np.ndarray:
        """Return the change of the residuals at the next of the values, ``(N,)``."""
        sign = np.sign(self.values[-1] - self.values[0])
        return self.residuals[np.searchsorted(sign * self.values, sign * value)] - self.residuals[0]


def profile(problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, column: int) -> Profile:
    """Return the profile of a parameter, from the value without effect on.

    Args:
        z: Shape ``(P,)``: the estimate.
    """
    p = problem.table.columns[column].parameter

    def over(values: np.ndarray) -> Profile:
        rows = np.full((_VALUES, len(at.x)), np.nan)
        rows[:, column] = values
        worse, moves, residuals = worse_with(problem, z, at, spread, rows, np.array([column]))
        return Profile(values, worse - min(worse.min(), 0.0), moves, residuals)

    if not p.limits:
        return over(np.concatenate([[0.0], np.geomspace(p.low, p.high, _VALUES - 1)]))
    wide = over(np.geomspace(p.high, p.low, _VALUES))
    # Take finer steps where the loss begins to grow, as it grows fast below the reached values.
    if (a := wide.last()) is None:
        return wide
    return over(np.concatenate([[p.high], np.geomspace(wide.values[a], wide.values[a + 1], _VALUES - 1)]))


def worse_with(
    problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, rows: np.ndarray, held: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the increase of the loss with values set ``(G,)``, the steps of the others ``(G, P)``, and the residuals.

    Args:
        z: Shape ``(P,)``: the estimate.
        rows: Shape ``(G, P)``: values; NaN starts from the estimate and is fitted.
        held: Numbers of parameters that are not fitted in any row.
    """
    size = len(at.x)
    # Pad to a fixed number of rows, so that one program serves all.
    padded = np.full((-(-len(rows) // _VALUES) * _VALUES, size), np.nan)
    padded[: len(rows)] = rows
    parts = [problem.with_values(z, part) for part in padded.reshape(-1, _VALUES, size)]
    r = np.concatenate(parts)[: len(rows)].reshape(len(rows), -1)
    # Fit the others, and compare with the same fit at the estimate.
    variance = loss_variance(problem, at) * float(np.median(spread.widening)) ** 2
    worse, moves = np.empty(len(rows)), np.zeros((len(rows), size))
    for k, row in enumerate(rows):
        rest = np.setdiff1d(np.flatnonzero(np.isnan(row)), held)
        before, _ = _refitted(at.residuals.reshape(-1), at, rest, variance)
        worse[k], moves[k, rest] = _refitted(r[k], at, rest, variance)
        worse[k] -= before
    return np.where(np.isfinite(worse), worse, np.inf) / variance, np.nan_to_num(moves), np.nan_to_num(r)


def _refitted(r: np.ndarray, at: Linearised, rest: np.ndarray, variance: float) -> tuple[float, np.ndarray]:
    """Return the sum of squares after a linear fit of some parameters to residuals ``(N,)``, and their step."""
    J = at.jacobian.reshape(-1, len(at.x))[:, rest]
    gradient = J.T @ r
    step = -np.linalg.solve(J.T @ J + variance * at.prior[np.ix_(rest, rest)], gradient)
    return float(r @ r + gradient @ step), step
