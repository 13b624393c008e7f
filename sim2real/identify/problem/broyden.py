"""Jacobians that a descent corrects from step to step, as each costs a rollout for every parameter."""

import numpy as np

from sim2real.identify.problem.evaluator import Stacked

_TRUSTED = 0.3
"""Largest error of the predicted change of the residuals, as a share of it, with which a Jacobian is corrected."""


Slope = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A point ``(P,)``, the residuals there ``(N,)``, and their Jacobian ``(N, P)``."""


def corrected(value: Stacked, slope: Stacked, nearby: Slope | None = None) -> tuple[Stacked, Stacked]:
    """Return the functions of a descent whose Jacobian is corrected after each step, and computed again if that fails.

    Broyden's rank-one correction is exact along the last step (Math. Comp. 19, 1965).

    Args:
        value: Residuals ``(N,)`` at a point ``(P,)``.
        slope: Their Jacobian ``(N, P)``, at the point of the last residuals.
        nearby: A Jacobian at a point nearby, which is corrected for the first point, too.
    """
    last: list[tuple[np.ndarray, np.ndarray]] = []  # the point of the last evaluation, and the residuals there
    accepted: list[Slope] = [] if nearby is None else [nearby]  # that of the last step

    def evaluated(y: np.ndarray) -> np.ndarray:
        if not (last and np.array_equal(last[0][0], y)):
            last[:] = [(y.copy(), value(y))]
        return last[0][1]

    def differentiated(y: np.ndarray) -> np.ndarray:
        # Differentiate at the first point, unless there is a Jacobian nearby; correct later ones by Broyden's rule.
        r = evaluated(y)
        J = slope(y) if not accepted else _updated(*accepted[0], y, r)
        accepted[:] = [(y.copy(), r, slope(y) if J is None else J)]
        return accepted[0][2]

    return evaluated, differentiated


def _updated(point: np.ndarray, before: np.ndarray, J: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray | None:
    """Return the corrected Jacobian after a step; None if the old one did not predict the step."""
    step = y - point
    expected = J @ step
    missed = r - before - expected
    length = float(step @ step)
    if length == 0.0:
        return J
    if not np.linalg.norm(missed) <= _TRUSTED * np.linalg.norm(expected):
        return None
    return J + np.outer(missed, step / length)
