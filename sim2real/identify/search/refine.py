"""Local refinement by least squares, and whether it converged.

scipy's trust-region method takes the steps on the host; an evaluator computes residuals and derivatives at a point. The
loss that decides is that with initial states solved for at the point itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.programs import OnCompile
from sim2real.identify.problem.segments import Data
from sim2real.identify.search.tether import Tether
from sim2real.identify.uncertainty.uncertainty import (
    deviation,
    linearise,
    loss_variance,
    root_of_inverse,
)

_COARSE = 1e-3
"""Relative gain of the loss at which the descent from each start ends; that from the best start continues."""
_ROUGH = 1e-2
"""The same for a model that others are compared with by percents."""
_ROUNDS, _BACK = 4, 4
"""Most rounds of a descent, and how often a round goes half the way back to its start."""
_NEAR = 1e-5
"""Relative change of the point at which a descent ends, if the evaluator resolves it."""
_LEFT = 0.1
"""A descent has converged if the next Gauss-Newton step is shorter [standard errors]."""
_POLLED, _REACH, _BETTER = 12, 0.5, 1e-3
"""Points that are tried around a descent that ended with more left; how far away [standard errors]; and by which share
their loss must be lower. Where friction sticks, the derivative at a point does not describe the points around it."""
_TRIES = 3
_FLAT, _INWARDS = 0.05, (0.25, 0.5, 0.75)
"""Distance from a bound within which a parameter hardly acts, and the distances at which it is tried [widths of the
bounds]: there the map to values is flat, and a friction has no effect, so a descent does not come back."""
OnStep = Callable[[float, np.ndarray], None]
"""Called with the best loss and point ``(P,)`` so far, after every evaluation."""


@dataclass(frozen=True)
class Refined:
    """Result of a refinement.

    Attributes:
        z: Shape ``(P,)``: the best point.
        before: Loss of the best start.
        steps: Evaluations, of all starts.
        left: Length of the next Gauss-Newton step [standard errors], of the parameter that it moves most.
        converged: Whether the loss has a minimum there: the next step is short, or no point around is better.
        ends: End of the descent from each start, ``(P,)``, and the loss there.
    """

    z: np.ndarray
    loss: float
    before: float
    steps: int
    left: float
    converged: bool
    ends: tuple[tuple[np.ndarray, float], ...] = ()


def refine(
    problem: Problem,
    starts: np.ndarray,
    data: Data | None = None,
    coarse: bool = False,
    settle: bool = True,
    gain: float | None = None,
    on_step: OnStep | None = None,
    on_compile: OnCompile | None = None,
) -> Refined:
    """Descend from each start, and from the best end to the minimum.

    Args:
        starts: Shape ``(K, P)``.
        coarse: Whether the first descents suffice, to compare with a model by percents.
        settle: Whether the end is tested, and points around it are tried if it is no minimum.
        gain: Relative gain of the loss at which the first descents end; default: by the other arguments.
    """
    descent = _Descent(problem, problem.data if data is None else data, on_step, on_compile)
    first = [descent.at(np.asarray(z, np.float64)) for z in starts]
    if not np.isfinite(first).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )
    # Descend roughly from each start.
    fine = problem.evaluator.precision
    first_gain = gain or (_ROUGH if coarse else _COARSE if settle else fine)
    ends = [descent.down(z, first_gain) for z in np.asarray(starts)[np.isfinite(first)]]
    z, loss = min(ends, key=lambda end: end[1])
    if coarse or not settle:
        return Refined(z, loss, float(np.nanmin(first)), descent.steps, np.nan, False, tuple(ends))
    # Descend from the best end to the minimum.
    z, loss = descent.down(z, fine)
    # Test the end; if it is no minimum, continue from a better point nearby.
    left, converged = remaining(problem, z, data), False
    for _ in range(_TRIES):
        if converged := left < _LEFT:
            break
        better = descent.around(z, loss)
        if converged := better is None:
            break
        z, loss = descent.down(better, fine)
        left = remaining(problem, z, data)
    return Refined(z, loss, float(np.nanmin(first)), descent.steps, left, converged, tuple(ends))


def remaining(problem: Problem, z: np.ndarray, data: Data | None = None) -> float:
    """Return how much is left of a descent: the largest move of the next Gauss-Newton step [standard errors].

    A scale-free test of convergence (Bates and Watts, Technometrics 23, 1981). Where the step leaves the bounds it ends
    there.

    Args:
        z: Shape ``(P,)``: the point.
        data: Segments to fit; default: all fitted ones.
    """
    at = linearise(problem, z, data)
    rest = np.arange(len(at.x))
    if data is not None:
        rest = rest[np.asarray(data.present)[rest]]
    J, variance = at.jacobian.reshape(-1, len(at.x))[:, rest], loss_variance(problem, at)
    root = root_of_inverse(J.T @ J / variance + at.prior[np.ix_(rest, rest)])
    covariance = root @ root.T
    away, slope = Tether(problem.table, problem.data if data is None else data).rows(at.x)
    step = -covariance @ (J.T @ at.residuals.reshape(-1) / variance + slope[:, rest].T @ away)
    low, high = problem.table.low[rest] - at.x[rest], problem.table.high[rest] - at.x[rest]
    return float(np.max(np.abs(np.clip(step, low, high)) / np.sqrt(np.diag(covariance)), initial=0.0))


class _Descent:
    """Descends on one problem and data.

    Attributes:
        tether: Holds what the log does not determine.
        steps: Evaluations so far.
    """

    def __init__(self, problem: Problem, data: Data, on_step: OnStep | None, on_compile: OnCompile | None) -> None:
        self._problem, self._data, self._on_step, self._on_compile = problem, data, on_step, on_compile
        self._best: tuple[float, np.ndarray] = (np.inf, np.zeros(0))
        self.tether = Tether(problem.table, data)
        self.steps = 0

    def at(self, z: np.ndarray) -> float:
        """Return the loss at a point, where initial states are linearised there."""
        loss = self._problem.loss(z, self._data, self._on_compile)
        self._report(loss, z)
        return loss

    def down(self, z: np.ndarray, gain: float) -> tuple[np.ndarray, float]:
        """Descend from a point until a round gains a smaller share of the loss; return where that ends, and its loss.

        In a round initial states may keep the derivatives that they have at its start. Where the loss is larger at its
        end once they are linearised there, the round goes back towards its start.

        Args:
            z: Shape ``(P,)``: the point.
        """
        z = np.asarray(z, np.float64)
        loss = self.at(z)
        # Rounds of Levenberg-Marquardt; a round that ends worse goes half way back.
        for _ in range(_ROUNDS):
            z, loss = self._off_bounds(z, loss)
            end = self._round(z, gain)
            held, after = loss + self._held(z), self.at(end)
            for _ in range(_BACK):
                if after + self._held(end) <= held:
                    break
                end = (z + end) / 2.0
                after = self.at(end)
            if not after + self._held(end) < held:
                break
            gained, z, loss = held - after - self._held(end), end, after
            # Where initial states are fresh, a further round only holds more loosely, as residuals are smaller.
            if gained < gain * loss or (self._problem.evaluator.fresh and self._held(z) < gain * loss):
                break
        return z, loss

    def around(self, z: np.ndarray, loss: float) -> np.ndarray | None:
        """Return a point that is better, seen before or within about a standard error; None if none of those is."""
        if self._best[0] < (1.0 - _BETTER) * loss:
            return self._best[1]
        table = self._problem.table
        at = linearise(self._problem, z, self._data)
        J, variance = at.jacobian.reshape(-1, len(at.x)), loss_variance(self._problem, at)
        root = root_of_inverse(J.T @ J / variance + at.prior)
        for draw in np.random.default_rng(0).normal(size=(_POLLED, len(at.x))):
            there = table.at_scale(at.x + _REACH * root @ draw)
            if self.at(there) < (1.0 - _BETTER) * loss:
                return there
        return None

    def _off_bounds(self, z: np.ndarray, loss: float) -> tuple[np.ndarray, float]:
        """Return a point with parameters next to bounds moved inwards, where that lowers the loss; and its loss."""
        table = self._problem.table
        x = table.scale(z)[0]
        share = (x - table.low) / table.span
        near = (share < _FLAT) | (share > 1.0 - _FLAT)
        flat = np.flatnonzero(near & np.asarray(self._data.present))
        if not len(flat):
            return z, loss
        # Move each alone.
        inwards = np.where(share[flat, None] < 0.5, _INWARDS, 1.0 - np.array(_INWARDS))
        to = table.low[flat, None] + inwards * table.span[flat, None]
        rows = np.repeat(x[None], to.size, axis=0)
        rows[np.arange(to.size), np.repeat(flat, to.shape[1])] = to.reshape(-1)
        losses = self._problem.losses(table.at_scale(rows), z, self._data).reshape(to.shape)
        losses = np.nan_to_num(losses, nan=np.inf)
        best, helps = losses.argmin(axis=1), losses.min(axis=1) < (1.0 - _BETTER) * loss
        # Move the one that helps most, or all that help.
        order = [i for i in np.argsort(losses.min(axis=1)) if helps[i]]
        for some in (order, order[:1]) if order else ():
            moved = x.copy()
            moved[flat[some]] = to[some, best[some]]
            there = table.at_scale(moved)
            if (lower := self.at(there)) < loss:
                return there, lower
        return z, loss

    def _held(self, z: np.ndarray) -> float:
        """Return what the tether adds to the loss."""
        return 0.5 * float(np.sum(self.tether.rows(self._problem.table.scale(z)[0])[0] ** 2) / self._data.count)

    def _round(self, z: np.ndarray, gain: float) -> np.ndarray:
        """Return where least squares ends from a point."""
        from scipy.optimize import least_squares  # 0.2 s

        # Linearise the initial states at the start of the round.
        value, slope = self._problem.evaluator.around(z, self._data)
        first, J = value(z), slope(z)
        if not (np.isfinite(first).all() and np.isfinite(J).all()):
            return z
        # End where no step can gain that share: steps that fail took 12 evaluations of each refit without a part.
        basis = np.linalg.qr(J[:, np.asarray(self._data.present)])[0]
        left = first - basis @ (basis.T @ first)
        if 1.0 - (left @ left) / max(float(first @ first), 1e-300) < gain:
            return z
        # Hold what the data does not determine by the residuals that the next step leaves, if the slope is right.
        self.tether.deviation = self._deviation(left)
        table = self._problem.table

        def tethered(y: np.ndarray) -> np.ndarray:
            self._report(np.inf, y)
            return np.nan_to_num(np.append(value(y), self.tether.rows(table.scale(y)[0])[0]), nan=np.inf)

        def tethered_slope(y: np.ndarray) -> np.ndarray:
            x, stretch = table.scale(y)
            return np.vstack([slope(y), self.tether.rows(x)[1] * stretch])

        # Descend with scipy.
        most, near = max(1, self._problem.config.refine_steps), max(_NEAR, self._problem.evaluator.precision)
        options: Any = {"jac": tethered_slope, "gtol": None}  # scipy's stubs have neither functions nor None
        return np.asarray(least_squares(tethered, z, ftol=gain, xtol=near, max_nfev=most, **options).x, np.float64)

    def _deviation(self, stacked: np.ndarray) -> float:
        """Return the deviation of the residuals of segments, behind which those of the priors stand, ``(N,)``."""
        of_segments = stacked[: len(stacked) - sum(c.parameter.prior is not None for c in self._problem.table.columns)]
        residuals = of_segments.reshape(len(self._data.fitted), -1, len(self._problem.fields))
        compared = np.zeros(residuals.shape[:2], bool)
        there = self._problem.compared(self._data)
        compared[: there.shape[0], : there.shape[1]] = there
        return deviation(residuals, compared)

    def _report(self, loss: float, z: np.ndarray) -> None:
        self.steps += 1
        if loss < self._best[0]:
            self._best = (loss, z.copy())
        if self._on_step and np.isfinite(self._best[0]):
            self._on_step(*self._best)
