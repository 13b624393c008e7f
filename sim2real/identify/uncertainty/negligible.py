"""Parameters that may as well be absent: the data bounds them on one side, and without them the model is as good.

On a logarithmic scale 0 is infinitely far away, so a friction that is not there ends anywhere near its lower bound,
with a standard error as wide as the bounds. What can be said of it is an upper bound, found by simulating with larger
values. A limit that no motion reaches, as a torque's, is its mirror image: it ends anywhere above what was reached, and
what can be said of it is a lower bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from sim2real.artifacts.identification import Determined
from sim2real.identify.parameters import Parameter
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.identifiability import from_linearised
from sim2real.identify.uncertainty.profile import ONE_SIDED, profile, worse_with
from sim2real.identify.uncertainty.uncertainty import VAGUE, Linearised, Uncertainty, scaled, time_shift

NEGLIGIBLE, NOT_REACHED = "negligible", "not reached"
ABSENT = (NEGLIGIBLE, NOT_REACHED)
"""Verdicts on parameters that may as well be absent."""
_SMALL = VAGUE * ONE_SIDED
"""An upper bound above this share of the highest value says too little: as for estimates, on a linear scale."""
_NEEDED = {False: 0.05, True: 0.0027}
"""How sure it must be that a parameter is needed, and of a limit, that it was reached: of many robots' limits none is,
and each time that chance says otherwise, an identification that lacks nothing is said to lack something.
"""
_ALIKE = 0.3
"""Cosine from which on two parameters have the same effect in part."""
Found = dict[int, tuple[float, np.ndarray, np.ndarray]]
"""Number of a parameter -> its one bound, how the others move there, and what that does to the residuals."""


def negligible(
    problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, check: Determined
) -> tuple[Uncertainty, Determined]:
    """Return the uncertainty with one bound for what may be absent, and the check of what is left.

    Others' intervals grow by how far they move when such a parameter is at its bound.

    Args:
        z: Shape ``(P,)``: the estimate.
    """
    table = problem.table
    open_names = {n for group in check.undetermined for n in group}
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
    found = _bounded(problem, z, at, spread, suspects)
    found = _apart(found, problem, at, check)
    if not found:
        return spread, check
    return _judged(problem, at, spread, found)


def indifferent(p: Parameter, bound: float) -> float:
    """Return the value of a limit that is not reached: any is as good, so the data sheet's, or the nearest there is.

    Args:
        bound: What it is at least.
    """
    return min(max(p.nominal, bound), p.high)


def _judged(problem: Problem, at: Linearised, spread: Uncertainty, found: Found) -> tuple[Uncertainty, Determined]:
    """Return the uncertainty with the bounds that were found, and the check of what is left."""
    table, size = problem.table, len(at.x)
    more, low, high = np.zeros(size), spread.low.copy(), spread.high.copy()
    cov = spread.scale_covariance
    for i, (bound, move, _) in found.items():
        others = np.setdiff1d(np.arange(size), list(found))
        more[others] += (move[others] / ONE_SIDED) ** 2
        p = table.columns[i].parameter
        low[i], high[i] = (bound, p.high) if p.limits else (0.0, bound)
    factor = np.sqrt(1.0 + more / np.maximum(np.diag(cov), 1e-300))
    wider = scaled(spread, table, at.x, factor)
    names, verdicts = [table.names[i] for i in found], list(wider.verdict)
    error, covariances = wider.standard_error.copy(), [wider.covariance.copy(), wider.scale_covariance.copy()]
    absent = np.isin(np.arange(size), list(found))
    low, high = np.where(absent, low, wider.low), np.where(absent, high, wider.high)
    for i, (bound, *_) in found.items():
        p = table.columns[i].parameter
        value = indifferent(p, bound) if p.limits else float(table.unscale(at.x)[i])
        verdicts[i] = NOT_REACHED if p.limits else NEGLIGIBLE
        # What training draws stays below the bound: on the scale, 95 % of it. Of a limit any value above is as good.
        far = p.high if p.limits else bound
        reach = abs(p.to_scale(far) - p.to_scale(value)) / ONE_SIDED
        error[i] = (far - value if p.limits else bound) / ONE_SIDED
        for c, own in zip(covariances, (error[i], max(reach, 1e-6)), strict=True):
            c[i, :] = c[:, i] = 0.0
            c[i, i] = own**2
    deviation = np.sqrt(np.diag(covariances[1]))
    spread = replace(
        wider, covariance=covariances[0], scale_covariance=covariances[1], standard_error=error, low=low, high=high,
        verdict=tuple(verdicts), correlation=covariances[1] / np.outer(deviation, deviation),
    )  # fmt: skip
    return spread, from_linearised(problem, at, without=names)


def _bounded(problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, suspects: Sequence[int]) -> Found:
    """Return what is found of each suspect that may be absent, together with those before it."""
    table, size = problem.table, len(at.x)
    profiles = {i: profile(problem, z, at, spread, i) for i in suspects}
    found: Found = {}
    for i, own in profiles.items():
        bound, p = own.bound(), table.columns[i].parameter
        if (
            bound is None
            or own.worse[0] > float(chdtri(1, 2 * _NEEDED[p.limits]))
            or (p.vanishes and bound > _SMALL * p.high)
        ):
            continue
        value = float(table.unscale(at.x)[i])
        said = min(bound, value) if p.limits else max(bound, value)
        found[i] = (said, own.moved(bound), own.effect(bound))
    order = sorted(found, key=lambda i: profiles[i].worse[0])
    # Two that stand for each other may each be absent, but not both.
    rows = np.full((max(len(order), 1), size), np.nan)
    for k, i in enumerate(order):
        rows[k:, i] = profiles[i].values[0]
    worse, *_ = worse_with(problem, z, at, spread, rows, np.arange(0))
    kept = 0
    needed = [_NEEDED[table.columns[i].parameter.limits] for i in order]
    while kept < len(order) and worse[kept] <= float(chdtri(kept + 1, needed[kept])):
        kept += 1
    return {i: found[i] for i in order[:kept]}


def _apart(found: Found, problem: Problem, at: Linearised, check: Determined) -> Found:
    """Return those whose effect is not also that of a parameter which the data leaves open: it may hide them."""
    table = problem.table
    open_names = {n for group in check.undetermined for n in group} - {table.names[i] for i in found}
    delays = {c.label for c in table.columns if c.parameter.kind == "delay"} if time_shift(table).any() else set[str]()
    J = at.jacobian.reshape(-1, len(at.x))[:, np.isin(table.names, list(open_names - delays))]
    size = np.linalg.norm(J, axis=0)
    alike = lambda effect: np.abs(effect @ J) / np.maximum(size * np.linalg.norm(effect), 1e-300)  # noqa: E731
    return {i: one for i, one in found.items() if alike(one[2]).max(initial=0.0) < _ALIKE}


def _far(p: Parameter, x: float) -> bool:
    """Return whether a place on a parameter's scale is in the half in which it has the more effect."""
    upper = x > (p.to_scale(p.low) + p.to_scale(p.high)) / 2
    return not upper if p.limits else upper
