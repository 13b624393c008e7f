"""Parameters that may be absent: the data gives them one bound, and the model without them is as good.

On a logarithmic scale 0 is infinitely far away. A friction that is absent therefore ends near its lower bound, with a
standard error as wide as the bounds; simulations with larger values give an upper bound. A limit that no motion
reaches, such as a torque's, is the mirror image: the data gives it a lower bound.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from sim2real.artifacts.identification import Determined
from sim2real.identify.parameters import Parameter
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.identifiability import from_linearised
from sim2real.identify.uncertainty.profile import ONE_SIDED, profile, worse_with
from sim2real.identify.uncertainty.uncertainty import VAGUE, Linearised, Uncertainty, scaled

NEGLIGIBLE, NOT_REACHED = "negligible", "not reached"
ABSENT = (NEGLIGIBLE, NOT_REACHED)
"""Verdicts on parameters that may be absent."""
_SMALL = VAGUE * ONE_SIDED
"""Largest useful upper bound, as a share of the highest value: as for estimates, on a linear scale."""
_NEEDED = {False: 0.05, True: 0.0027}
"""Probability by chance below which a parameter is needed; of a limit, below which it was reached. It is smaller for
limits, as each of a robot's many limits is a chance of a false verdict."""
_ALIKE = 0.3
"""Cosine above which two parameters have a common effect."""
Bounds = dict[int, tuple[float, np.ndarray, np.ndarray]]
"""Number of a parameter -> its bound, how the others move there, and the effect on the residuals."""


def negligible(
    problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, check: Determined
) -> tuple[Uncertainty, Determined]:
    """Return the uncertainty with one bound for parameters that may be absent, and the check of the others.

    The intervals of other parameters grow by the distance that they move when such a parameter is at its bound.

    Args:
        z: Shape ``(P,)``: the estimate.
    """
    table = problem.table
    open_names = {n for group in check.undetermined for n in group}
    # Suspect parameters that can vanish or limit, and whose interval is not accepted.
    suspects = [
        i
        for i, c in enumerate(table.columns)
        if (c.parameter.vanishes or c.parameter.limits)
        and not c.parameter.narrowed
        and c.recording is None
        and (spread.verdict[i] != "accepted" or c.label in open_names)
        and not (spread.verdict[i] == "at a bound" and _far(c.parameter, at.x[i]))
    ]
    if not suspects:
        return spread, check
    # Compute bounds of the suspects, and test them together.
    bounds = _bounded(problem, z, at, spread, suspects)
    bounds = _apart(bounds, problem, at, check)
    if not bounds:
        return spread, check
    return _judged(problem, at, spread, bounds)


def indifferent(p: Parameter, bound: float) -> float:
    """Return the value of a limit that is not reached: the nominal value, or the possible value nearest to it.

    Args:
        bound: Lower bound of the limit.
    """
    return min(max(p.nominal, bound), p.high)


def _judged(problem: Problem, at: Linearised, spread: Uncertainty, bounds: Bounds) -> tuple[Uncertainty, Determined]:
    """Return the uncertainty with these bounds, and the check of the other parameters."""
    table, size = problem.table, len(at.x)
    more, low, high = np.zeros(size), spread.low.copy(), spread.high.copy()
    cov = spread.scale_covariance
    # Widen the intervals of the others by their moves.
    for i, (bound, move, _) in bounds.items():
        others = np.setdiff1d(np.arange(size), list(bounds))
        more[others] += (move[others] / ONE_SIDED) ** 2
        p = table.columns[i].parameter
        low[i], high[i] = (bound, p.high) if p.limits else (0.0, bound)
    factor = np.sqrt(1.0 + more / np.maximum(np.diag(cov), 1e-300))
    wider = scaled(spread, table, at.x, factor)
    names, verdicts = [table.names[i] for i in bounds], list(wider.verdict)
    error, covariances = wider.standard_error.copy(), [wider.covariance.copy(), wider.scale_covariance.copy()]
    # Replace the intervals of the absent parameters by their bound.
    absent = np.isin(np.arange(size), list(bounds))
    low, high = np.where(absent, low, wider.low), np.where(absent, high, wider.high)
    for i, (bound, *_) in bounds.items():
        p = table.columns[i].parameter
        value = indifferent(p, bound) if p.limits else float(table.unscale(at.x)[i])
        verdicts[i] = NOT_REACHED if p.limits else NEGLIGIBLE
        # Of the values that training draws, 95 % stay below the bound. Of a limit, all values above it are alike.
        far = p.high if p.limits else bound
        reach = abs(p.to_scale(far) - p.to_scale(value)) / ONE_SIDED
        error[i] = (far - value if p.limits else bound) / ONE_SIDED
        for c, variance_root in zip(covariances, (error[i], max(reach, 1e-6)), strict=True):
            c[i, :] = c[:, i] = 0.0
            c[i, i] = variance_root**2
    deviation = np.sqrt(np.diag(covariances[1]))
    spread = replace(
        wider, covariance=covariances[0], scale_covariance=covariances[1], standard_error=error, low=low, high=high,
        verdict=tuple(verdicts), correlation=covariances[1] / np.outer(deviation, deviation),
    )  # fmt: skip
    return spread, from_linearised(problem, at, without=names)


def _bounded(problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, suspects: Sequence[int]) -> Bounds:
    """Return the bounds of the suspects that may be absent, together with all suspects before them."""
    # Profile each suspect: the loss at its bound, with the other parameters free.
    table, size = problem.table, len(at.x)
    profiles = {i: profile(problem, z, at, spread, i) for i in suspects}
    bounds: Bounds = {}
    # Keep those that the log allows at their bound.
    for i, curve in profiles.items():
        bound, p = curve.bound(), table.columns[i].parameter
        if (
            bound is None
            or curve.worse[0] > float(chdtri(1, 2 * _NEEDED[p.limits]))
            or (p.vanishes and bound > _SMALL * p.high)
        ):
            continue
        value = float(table.unscale(at.x)[i])
        limit = min(bound, value) if p.limits else max(bound, value)
        bounds[i] = (limit, curve.moved(bound), curve.effect(bound))
    order = sorted(bounds, key=lambda i: profiles[i].worse[0])
    # Test them together: of two that imitate each other, one may be absent, but not both.
    rows = np.full((max(len(order), 1), size), np.nan)
    for k, i in enumerate(order):
        rows[k:, i] = profiles[i].values[0]
    worse, *_ = worse_with(problem, z, at, spread, rows, np.arange(0))
    count = 0
    needed = [_NEEDED[table.columns[i].parameter.limits] for i in order]
    while count < len(order) and worse[count] <= float(chdtri(count + 1, needed[count])):
        count += 1
    return {i: bounds[i] for i in order[:count]}


def _apart(bounds: Bounds, problem: Problem, at: Linearised, check: Determined) -> Bounds:
    """Return those whose effect differs from that of every undetermined parameter, which could hide them."""
    table = problem.table
    open_names = {n for group in check.undetermined for n in group} - {table.names[i] for i in bounds}
    J = at.jacobian.reshape(-1, len(at.x))[:, np.isin(table.names, list(open_names))]
    size = np.linalg.norm(J, axis=0)
    alike = lambda effect: np.abs(effect @ J) / np.maximum(size * np.linalg.norm(effect), 1e-300)  # noqa: E731
    return {i: one for i, one in bounds.items() if alike(one[2]).max(initial=0.0) < _ALIKE}


def _far(p: Parameter, x: float) -> bool:
    """Return whether a place on a parameter's scale is in the half where the parameter has more effect."""
    upper = x > (p.to_scale(p.low) + p.to_scale(p.high)) / 2
    return not upper if p.limits else upper
