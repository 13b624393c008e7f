"""Parameters that may as well be absent: the data bounds them from above, and without them the model is as good.

On a logarithmic scale 0 is infinitely far away, so a friction that is not there ends anywhere near its lower bound,
with a standard error as wide as the bounds. What can be said of it is an upper bound, found by simulating with larger
values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri

from sim2real.identify.identifiability import Check, from_linearised
from sim2real.identify.problem import Problem
from sim2real.identify.programs import program
from sim2real.identify.robust import tamed
from sim2real.identify.uncertainty import VAGUE, Linearised, Uncertainty, loss_variance, scaled, time_shift

NEGLIGIBLE = "negligible"
_ONE_SIDED = 1.645
"""Standard deviations below which 95 % of a normal distribution lie; squared, what the loss may grow by at a bound."""
_SMALL = VAGUE * _ONE_SIDED
"""An upper bound above this share of the highest value says too little: as for estimates, on a linear scale."""
_VALUES = 12
_ALIKE = 0.3
"""Cosine from which on two parameters have the same effect in part."""
Found = dict[int, tuple[float, np.ndarray, np.ndarray]]
"""Number of a parameter -> its upper bound, how the others move there, and what that does to the residuals."""


@dataclass(frozen=True)
class Profile:
    """How much worse the model is for values of one parameter, all others fitted anew.

    Attributes:
        values: Shape ``(V,)``, ascending, the floor first.
        worse: Shape ``(V,)``: sum of squares over its variance, above the smallest; 1 is one standard deviation.
        moves: Shape ``(V, P)``: how the others move, on their scales.
        residuals: Shape ``(V, N)``: without that move.
    """

    values: np.ndarray
    worse: np.ndarray
    moves: np.ndarray
    residuals: np.ndarray

    def upper(self) -> float | None:
        """Return the upper end of a one-sided interval of 95 %; None where the data does not bound the parameter."""
        good = np.flatnonzero(self.worse <= _ONE_SIDED**2)
        if not len(good) or good[-1] + 1 == len(self.values):
            return None
        a, b = good[-1], good[-1] + 1
        # The square root grows like the value itself, as in a linear model.
        return float(np.interp(_ONE_SIDED, np.sqrt(self.worse[[a, b]]), self.values[[a, b]]))


def negligible(
    problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, check: Check
) -> tuple[Uncertainty, Check]:
    """Return the uncertainty with upper bounds for what may be absent, and the check of what is left.

    Others' intervals grow by how far they move when such a parameter is at its upper bound.

    Args:
        problem: The residuals.
        z: Shape ``(P,)``: the estimate.
        at: The residuals there.
        spread: Its uncertainty.
        check: What the data determines there.
    """
    table = problem.table
    open_names = {n for group in check.undetermined for n in group}
    suspects = [
        i
        for i, c in enumerate(table.columns)
        if c.parameter.vanishes
        and not c.parameter.narrowed
        and c.recording is None
        and (spread.verdict[i] != "accepted" or c.label in open_names)
        and not (spread.verdict[i] == "at a bound" and at.x[i] > (table.low[i] + table.high[i]) / 2)
    ]
    if not suspects:
        return spread, check
    found = _bounded(problem, z, at, spread, suspects)
    found = _apart(found, problem, at, check)
    if not found:
        return spread, check
    return _judged(problem, at, spread, found)


def _judged(problem: Problem, at: Linearised, spread: Uncertainty, found: Found) -> tuple[Uncertainty, Check]:
    """Return the uncertainty with the bounds that were found, and the check of what is left."""
    table, size = problem.table, len(at.x)
    more, high = np.zeros(size), spread.high.copy()
    cov = spread.scale_covariance
    for i, (bound, move, _) in found.items():
        others = np.setdiff1d(np.arange(size), list(found))
        more[others] += (move[others] / _ONE_SIDED) ** 2
        high[i] = bound
    factor = np.sqrt(1.0 + more / np.maximum(np.diag(cov), 1e-300))
    wider = scaled(spread, table, at.x, factor)
    names, verdicts = [table.names[i] for i in found], list(wider.verdict)
    error, covariances = wider.standard_error.copy(), [wider.covariance.copy(), wider.scale_covariance.copy()]
    low, high = wider.low.copy(), np.where(np.isin(np.arange(size), list(found)), high, wider.high)
    for i, (bound, *_) in found.items():
        p = table.columns[i].parameter
        value, verdicts[i] = float(table.unscale(at.x)[i]), NEGLIGIBLE
        low[i], error[i] = 0.0, bound / _ONE_SIDED
        # What training draws stays below the bound: on the scale, 95 % of it.
        reach = max(p.to_scale(bound) - p.to_scale(min(value, bound)), 0.0) / _ONE_SIDED
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
    profiles = {i: _profile(problem, z, at, spread, i) for i in suspects}
    found: Found = {}
    for i, profile in profiles.items():
        upper, p = profile.upper(), table.columns[i].parameter
        if upper is None or profile.worse[0] > _ONE_SIDED**2 or upper > _SMALL * p.high:
            continue
        beyond = int(np.searchsorted(profile.values, upper))
        moves = np.array([np.interp(upper, profile.values, own) for own in profile.moves.T])
        effect = profile.residuals[beyond] - profile.residuals[0]
        found[i] = (max(upper, float(table.unscale(at.x)[i])), moves, effect)
    order = sorted(found, key=lambda i: profiles[i].worse[0])
    # Two that stand for each other may each be absent, but not both.
    rows = np.full((max(len(order), 1), size), np.nan)
    for k, i in enumerate(order):
        rows[k:, i] = 0.0
    worse, *_ = _worse(problem, z, at, spread, rows, np.arange(0))
    kept = 0
    while kept < len(order) and worse[kept] <= float(chdtri(kept + 1, 0.05)):
        kept += 1
    return {i: found[i] for i in order[:kept]}


def _apart(found: Found, problem: Problem, at: Linearised, check: Check) -> Found:
    """Return those whose effect is not also that of a parameter which the data leaves open: it may hide them."""
    table = problem.table
    open_names = {n for group in check.undetermined for n in group} - {table.names[i] for i in found}
    delays = {c.label for c in table.columns if c.parameter.kind == "delay"} if time_shift(table).any() else set[str]()
    J = at.jacobian.reshape(-1, len(at.x))[:, np.isin(table.names, list(open_names - delays))]
    size = np.linalg.norm(J, axis=0)
    alike = lambda effect: np.abs(effect @ J) / np.maximum(size * np.linalg.norm(effect), 1e-300)  # noqa: E731
    return {i: one for i, one in found.items() if alike(one[2]).max(initial=0.0) < _ALIKE}


def _profile(problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, column: int) -> Profile:
    """Return how much worse the model is for values of a parameter from 0 to its upper bound."""
    p = problem.table.columns[column].parameter
    values = np.concatenate([[0.0], np.geomspace(p.low, p.high, _VALUES - 1)])
    rows = np.full((_VALUES, len(at.x)), np.nan)
    rows[:, column] = values
    worse, moves, residuals = _worse(problem, z, at, spread, rows, np.array([column]))
    return Profile(values, worse - min(worse.min(), 0.0), moves, residuals)


def _worse(
    problem: Problem, z: np.ndarray, at: Linearised, spread: Uncertainty, rows: np.ndarray, held: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how much worse the model is with some values given, ``(G,)``; how all others move, ``(G, P)``; residuals.

    Args:
        problem: The residuals.
        z: Shape ``(P,)``: the estimate.
        at: The residuals there.
        spread: Its uncertainty.
        rows: Shape ``(G, P)``: values; NaN: the estimate, from which the parameter is fitted anew.
        held: Numbers of those that are not fitted anew in any row.
    """
    size = len(at.x)
    if "given" not in problem.programs:
        problem.programs["given"] = program(lambda z, columns, rows: _with_values(problem, z, columns, rows))
    columns, _ = problem.at(z)
    # Rows of one number: one program serves all.
    padded = np.full((-(-len(rows) // _VALUES) * _VALUES, size), np.nan)
    padded[: len(rows)] = rows
    found = [
        np.asarray(problem.programs["given"](jnp.asarray(z, jnp.float32), columns, jnp.asarray(part, jnp.float32)))
        for part in padded.reshape(-1, _VALUES, size)
    ]
    r = np.concatenate(found)[: len(rows)].reshape(len(rows), -1).astype(np.float64)
    variance = loss_variance(problem, at) * float(np.median(spread.widening)) ** 2
    worse, moves = np.empty(len(rows)), np.zeros((len(rows), size))
    for k, row in enumerate(rows):
        rest = np.setdiff1d(np.flatnonzero(np.isnan(row)), held)
        before, _ = _refitted(at.residuals.reshape(-1), at, rest, variance)
        worse[k], moves[k, rest] = _refitted(r[k], at, rest, variance)
        worse[k] -= before
    return np.where(np.isfinite(worse), worse, np.inf) / variance, np.nan_to_num(moves), np.nan_to_num(r)


def _with_values(problem: Problem, z: Any, columns: Any, rows: Any) -> Any:
    """Return the robust residuals of all fitted segments with some values given, ``(G, S, C, F)``; as ``_worse``."""
    values, pick = problem.table.decode(z), jnp.asarray(problem.train)

    def one(row: Any) -> Any:
        own = dict(values)
        for i, c in enumerate(problem.table.columns):
            if c.recording is None:
                own[c.label] = jnp.where(jnp.isnan(row[i]), values[c.label], row[i])
        r = jax.vmap(lambda e, s: problem.projected(own, e, s)[0])(pick, columns)
        return tamed(r, problem.config.loss, problem.config.reach)

    return jax.vmap(one)(rows)


def _refitted(r: np.ndarray, at: Linearised, rest: np.ndarray, variance: float) -> tuple[float, np.ndarray]:
    """Return the sum of squares after a linear fit of some parameters to residuals ``(N,)``, and their step."""
    J = at.jacobian.reshape(-1, len(at.x))[:, rest]
    gradient = J.T @ r
    step = -np.linalg.solve(J.T @ J + variance * at.prior[np.ix_(rest, rest)], gradient)
    return float(r @ r + gradient @ step), step
