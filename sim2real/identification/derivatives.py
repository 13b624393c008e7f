"""Jacobians by few finite differences: independent columns move together, and steps correct the matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from sim2real.types import MjModel

mj: Any = mujoco

_RESPONDS = 1e-9
"""A derivative below this share of the largest one counts as 0; derivatives of separate joints are exactly 0."""
_TRUSTED = 0.3
"""Largest relative error of a predicted change of the residuals for which the Jacobian is corrected, not computed
again.
"""
Stacked = Callable[[np.ndarray], np.ndarray]


class Groups:
    """Columns of a Jacobian that finite differences move together, as no residual depends on two of them.

    Method of Curtis, Powell and Reid (J. Inst. Maths Applics 13, 1974). For example, one rollout gives the derivatives
    by the motor strengths of four legs that do not touch each other.

    Args:
        apart: Whether joints of separate trees are independent; otherwise each column is moved alone.
        by_tree: Whether a column counts as acting on all residuals of its tree, because it may do so at other points.
    """

    def __init__(self, apart: bool, by_tree: bool = False) -> None:
        self._apart, self._by_tree, self._belongs = apart, by_tree, np.zeros((0, 0), bool)

    def members(self, columns: Sequence[int]) -> list[list[int]]:
        """Return the groups of some columns; before the first Jacobian, each column is a group."""
        if not self._belongs.size:
            return [[c] for c in columns]
        groups: list[tuple[list[int], np.ndarray]] = []
        for c in columns:
            belongs = self._belongs[c]
            free = next((g for g in groups if not (g[1] & belongs).any()), None)
            if free is None:
                groups.append(([c], belongs.copy()))
            else:
                free[0].append(c)
                np.logical_or(free[1], belongs, out=free[1])
        return [members for members, _ in groups]

    def spread(self, changes: np.ndarray, groups: Sequence[Sequence[int]], width: np.ndarray) -> np.ndarray:
        """Return derivatives ``(size, ..., F)`` from changes along groups ``(G, ..., F)``.

        Args:
            width: Shape ``(size,)``: by how much each column was moved.
        """
        J = np.zeros((len(width), *changes.shape[1:]))
        for change, members in zip(changes, groups, strict=True):
            for c in members:
                np.divide(change if len(members) == 1 else np.where(self._belongs[c], change, 0.0), width[c], out=J[c])
        if self._apart and not self._belongs.size:
            self._belongs = self._found(np.abs(J).max(axis=tuple(range(1, J.ndim - 1))))
        return J

    def _found(self, slope: np.ndarray) -> np.ndarray:
        """Return which residuals belong to each column ``(n, F)``, bool, from the largest derivatives ``(n, F)``."""
        belongs = slope > _RESPONDS * slope.max(axis=1, keepdims=True)
        if self._by_tree:
            for _ in range(len(belongs)):  # columns that share a residual share all of them
                shares = (belongs.astype(int) @ belongs.T.astype(int)) > 0
                belongs = (shares.astype(int) @ belongs.astype(int)) > 0
        # A column without effect at this point may have an effect elsewhere: move it alone.
        belongs[~belongs.any(axis=1)] = True
        return belongs


def trees_are_apart(model: MjModel | None) -> bool:
    """Return whether joints of separate trees are independent: the model has no contact, equality or tendon."""
    if model is None:
        return False
    contacts = model.opt.disableflags & mj.mjtDisableBit.mjDSBL_CONTACT == 0
    touching = contacts and (model.npair > 0 or bool(np.any(model.geom_contype) and np.any(model.geom_conaffinity)))
    return model.ntree > 1 and not touching and model.neq == 0 and model.ntendon == 0


class Nearby:
    """Residuals near a point, and their Jacobian, which is corrected after each step, and computed again if that fails.

    The correction is Broyden's rank-one update (Math. Comp. 19, 1965), in place: an arm's Jacobian has 100 MB.

    Args:
        value: Residuals ``(N,)`` at a point ``(P,)``.
        slope: Their Jacobian ``(P, N)``, a row for each parameter.
        scale: Shape ``(P,)``: typical step of each parameter, so that steps of different units compare.
        known: Point, residuals and Jacobian of an earlier evaluation nearby, from which the first Jacobian is made.
        most: Most Jacobians that are computed; later ones are only corrected. Default: as many as needed.
    """

    def __init__(
        self,
        value: Stacked,
        slope: Stacked,
        scale: np.ndarray | float = 1.0,
        known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
        most: int | None = None,
    ) -> None:
        self._value, self._slope, self._scale = value, slope, scale
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # the point of the last evaluation, and the residuals
        self._known, self._left, self._computed = known, np.inf if most is None else most, False

    def residuals(self, y: np.ndarray) -> np.ndarray:
        """Return the residuals at a point."""
        if self._last is None or not np.array_equal(self._last[0], y):
            self._last = (y.copy(), self._value(y))
        return self._last[1]

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """Return the Jacobian ``(P, N)`` at the point of the last step."""
        if self._known is not None and np.array_equal(self._known[0], y):
            return self._known[2]
        r, J = self.residuals(y), None
        if self._known is not None:
            J = _updated(*self._known, y, r, self._scale, _TRUSTED if self._left > 0 else np.inf)
        self._computed = J is None
        self._known = (y.copy(), r, self._compute(y) if J is None else J)
        return self._known[2]

    def renew(self, y: np.ndarray) -> bool:
        """Compute the Jacobian anew at the last step; return False if it is new, or ``most`` is reached."""
        if self._computed or self._left <= 0:
            return False
        self._computed = True
        self._known = (y.copy(), self.residuals(y), self._compute(y))
        return True

    def _compute(self, y: np.ndarray) -> np.ndarray:
        self._left -= 1
        return self._slope(y)


def _updated(
    point: np.ndarray,
    before: np.ndarray,
    J: np.ndarray,
    y: np.ndarray,
    r: np.ndarray,
    scale: np.ndarray | float,
    trusted: float,
) -> np.ndarray | None:
    """Correct a Jacobian ``(P, N)`` by a step and return it; None if the old one predicted the step badly."""
    step = y - point
    expected = step @ J
    missed = r - before - expected
    direction = step / scale**2
    length = float(step @ direction)
    if length == 0.0:
        return J
    if not np.linalg.norm(missed) <= trusted * np.linalg.norm(expected):
        return None
    for row, share in zip(J, direction / length, strict=True):
        row += share * missed
    return J
