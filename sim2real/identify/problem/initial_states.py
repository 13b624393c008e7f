"""Initial states of segments on C MuJoCo: Gauss-Newton steps on the host, with finite differences.

Rollouts take most of the time. Joints of separate kinematic trees move independently, so one rollout serves a state of
each tree. The states at the last points are cached, as a descent uses them again.
"""

from collections.abc import Callable, Mapping
from itertools import zip_longest
from typing import Any

import mujoco
import numpy as np

from sim2real.identify.problem.residuals import STATE_DIFFERENCE, InitialState, SegmentResiduals
from sim2real.identify.problem.segments import Data
from sim2real.types import MjModel

mj: Any = mujoco

_STEPS = 2
"""Gauss-Newton steps of an initial state; they share the derivatives at the first point."""
_CACHED = 3
"""Cached points: a descent evaluates its end, then begins its next round there."""
_RESPONDS = 1e-9
"""Share of the largest derivative below which a residual is independent of a state; decoupled derivatives are exactly
0."""
Errors = Callable[[Mapping[str, np.ndarray], np.ndarray, np.ndarray, Data], np.ndarray]
"""Residuals ``(N, K, F)`` of segments ``(N,)`` with parameters ``(N, ...)`` by name and shifts ``(N, n)``."""


class InitialStates:
    """Fits the initial states of segments."""

    def __init__(self, residuals: SegmentResiduals, errors: Errors, model: MjModel) -> None:
        self._errors, self._n = errors, len(residuals.prior)
        self._groups: list[tuple[int, ...]] | None = None if trees_are_apart(model) else _each(self._n)
        self._responds = np.ones((self._n, len(residuals.fields)), bool)
        self._last: list[tuple[bytes, Data, bool, InitialState]] = []

    def fitted(self, z: np.ndarray, values: Mapping[str, np.ndarray], data: Data, again: bool = False) -> InitialState:
        """Return the initial states of the segments that have a weight, leaves ``(S, ...)``.

        Args:
            z: Shape ``(P,)``: the parameters.
            values: The parameters by name, ``(1, ...)``.
            again: Whether the derivatives are computed at the fitted states.
        """
        # Return the states of an earlier call at this point.
        for point, cached_data, was_linearised, states in self._last:
            if point == z.tobytes() and cached_data is data and was_linearised is again:
                return states
        # Fit the states of segments with weight, or only linearise them again.
        live = np.flatnonzero(np.asarray(data.weight) > 0.0)
        segments = np.asarray(data.fitted)[live]
        spread = {n: np.repeat(v, len(live), axis=0) for n, v in values.items()}
        if again:
            before = self.fitted(z, values, data)
            fitted = InitialState(*(leaf[live] for leaf in before))
            fitted = fitted._replace(slope=self._slopes(spread, segments, np.asarray(fitted.shift), data)[0])
        else:
            fitted = self.best(spread, segments, np.full(len(live), float(data.length_s)), data, 1)
        # Fill up with zeros, and store the result.
        whole = [np.zeros((len(data.fitted), *leaf.shape[1:])) for leaf in fitted]
        for leaf, values_ in zip(whole, fitted, strict=True):
            leaf[live] = values_
        states = InitialState(*whole)
        self._last = [(z.tobytes(), data, again, states), *self._last[: _CACHED - 1]]
        return states

    def best(
        self, values: Mapping[str, np.ndarray], eps: np.ndarray, fit_s: np.ndarray, data: Data, steps: int = _STEPS + 1
    ) -> InitialState:
        """Fit the initial states of segments; return shifts, derivatives at no shift, and residuals.

        The residuals are those of the best point of the steps.

        Args:
            values: Parameters of each segment by name, ``(R, ...)``.
            eps: Shape ``(R,)``: numbers of the segments.
            fit_s: Shape ``(R,)``: length of the first part of each, to which its state is fitted [s].
        """
        # Linearise at the estimate from the log.
        still = np.zeros((len(eps), self._n))
        slope, errors = self._slopes(values, eps, still, data)
        ts = np.asarray(data.ts)[eps]
        counts = ((ts >= 0.0) & (ts <= fit_s[:, None]))[..., None]
        best = InitialState(still, slope, errors)
        least, candidate = _cost(best, counts), next_shift(best, counts)
        # Step with these derivatives, and keep the best point.
        for _ in range(steps):
            here = InitialState(candidate, slope, self._errors(values, eps, candidate, data))
            cost = _cost(here, counts)
            better = cost < least
            shift = np.where(better[:, None], here.shift, best.shift)
            residuals = np.where(better[:, None, None], here.residuals, best.residuals)
            best, least = InitialState(shift, slope, residuals), np.where(better, cost, least)
            # Near kinks, such as sticking friction, a full step may increase the cost: go half way back.
            candidate = np.where(better[:, None], next_shift(best, counts), (candidate + shift) / 2.0)
        return best

    def _slopes(
        self, values: Mapping[str, np.ndarray], eps: np.ndarray, shift: np.ndarray, data: Data
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives ``(R, n, K, F)`` by initial states at shifts ``(R, n)``, and residuals ``(R, K, F)``."""
        # Move all states of a group in one rollout, up and down.
        groups = self._groups or _each(self._n)
        member = np.array([[i in group for i in range(self._n)] for group in groups], float)
        moves = STATE_DIFFERENCE * np.concatenate([np.zeros((1, self._n)), member, -member])
        spread = {k: np.repeat(v, len(moves), axis=0) for k, v in values.items()}
        shifts = (shift[:, None] + moves).reshape(-1, self._n)
        errors = self._errors(spread, np.repeat(eps, len(moves)), shifts, data)
        errors = errors.reshape(len(eps), len(moves), *errors.shape[1:])
        count = len(groups)
        change = (errors[:, 1 : count + 1] - errors[:, count + 1 :]) / (2.0 * STATE_DIFFERENCE)
        # Assign the change to the state in the same tree as the residual.
        slope = np.empty((len(eps), self._n, *errors.shape[2:]))
        for i, group in enumerate(groups):
            for k in group:
                slope[:, k] = np.where(self._responds[k], change[:, i], 0.0)
        # Find the groups from the first derivatives.
        if self._groups is None:
            self._groups, self._responds = separated(np.max(np.abs(slope), axis=(0, 2)))
        return slope, errors[:, 0]


def separated(slope: np.ndarray) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """Return which columns can be moved together, as no residual depends on two of them, and their residuals.

    Method of Curtis, Powell and Reid (J. Inst. Maths Applics 13, 1974). A column without effect at this point is moved
    alone, as it may have an effect at another one.

    Args:
        slope: Shape ``(n, F)``: largest derivative of each residual by each column.

    Returns:
        The groups; and shape ``(n, F)``, bool: which residuals belong to the tree of each column.
    """
    responds = slope > _RESPONDS * slope.max(initial=0.0)
    alone = [i for i in range(len(slope)) if not responds[i].any()]
    # Columns and residuals that depend on each other, directly or by way of others, are of one tree.
    label, rows = np.arange(len(slope)), np.full(slope.shape[1], len(slope))
    # Each takes the lowest number among its neighbours; SciPy is no part of the light installation.
    for _ in label:
        rows = np.minimum(rows, np.where(responds, label[:, None], len(slope)).min(axis=0, initial=len(slope)))
        label = np.minimum(label, np.where(responds, rows, len(slope)).min(axis=1, initial=len(slope)))
    columns = label
    belongs = columns[:, None] == rows[None]
    belongs[alone] = True
    trees = [[i for i in np.flatnonzero(columns == k) if i not in alone] for k in np.unique(columns)]
    groups = [tuple(int(i) for i in group if i is not None) for group in zip_longest(*trees)]
    return [g for g in groups if g] + [(i,) for i in alone], belongs


def next_shift(at: InitialState, counts: np.ndarray) -> np.ndarray:
    """Return the shifts ``(R, n)`` after a Gauss-Newton step.

    Args:
        at: The states, leaves ``(R, ...)``.
        counts: Shape ``(R, K, 1)``, bool: which measurements count.
    """
    J = np.where(counts[:, None], at.slope, 0.0).reshape(*at.slope.shape[:2], -1)
    r = np.where(counts, at.residuals, 0.0).reshape(len(J), -1)
    H = J @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
    pull = np.einsum("rnk,rk->rn", J, r) + at.shift
    return at.shift - np.linalg.solve(np.nan_to_num(H), np.nan_to_num(pull)[..., None])[..., 0]


def _cost(at: InitialState, counts: np.ndarray) -> np.ndarray:
    return np.sum(np.where(counts, at.residuals, 0.0) ** 2, axis=(1, 2)) + np.sum(at.shift**2, axis=1)


def _each(n: int) -> list[tuple[int, ...]]:
    return [(i,) for i in range(n)]


def trees_are_apart(model: MjModel) -> bool:
    """Return whether only bodies couple joints: there is no contact, equality or tendon."""
    contacts = model.opt.disableflags & mj.mjtDisableBit.mjDSBL_CONTACT == 0
    touching = contacts and (model.npair > 0 or bool(np.any(model.geom_contype) and np.any(model.geom_conaffinity)))
    return model.ntree > 1 and not touching and model.neq == 0 and model.ntendon == 0
