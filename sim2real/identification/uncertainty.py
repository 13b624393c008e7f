"""How well recordings determine parameters: covariance, intervals, undetermined parameters, noise.

The covariance is that of a linear model with the variance of the residuals. Two things widen it: correlation of the
residuals in time, and differences between the estimates that leave out one part of the recordings each.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sim2real.artifacts.identification import Noise, OverLogs
from sim2real.errors import UsageError
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Linearised, Problem, of_recordings
from sim2real.later import special

VAGUE = 0.15
"""A parameter is not determined if its standard error is above this share of the bounds' width (uniform: 0.29)."""
AT_BOUND = 0.005
"""An estimate within this share of the bounds' width of a bound counts as at the bound."""
OK, ABSENT, NOT_REACHED, BOUND, UNDETERMINED = "ok", "absent", "not reached", "at a bound", "not determined"
"""States of a parameter: determined; negligible, as it may be 0; a limit that no motion reached; ..."""
_ONE_SIDED = 1.645
"""One-sided 95 % quantile of a normal distribution."""
_BLOCKS = 20
"""Most parts of the recordings that are left out in turn, by a linear step."""
_FEWEST = 4
"""Fewest parts for which the spread of estimates is computed."""
_RESOLVED = 1e-13
"""Smallest eigenvalue of a precision matrix with a diagonal of ones: smaller ones are rounding errors."""
_ALONE = 0.5
"""If one part has this share of the information about a parameter, the other parts do not show how much it varies."""
_BY_CHANCE = (0.2, 0.05)
"""Intervals begin to widen at the first probability that chance alone makes the parts differ as much, and widen in full
at the second. With one sharp limit, the last digits of a fit decided whether an interval doubled.
"""
_WITH_IT = 0.5
"""A parameter vanishes with another one if it must change by this share so that the other one may be 0."""
_TAKES_PART = 0.1
"""A parameter takes part in a direction if its entry is above this share of the largest entry."""
_ORDER, _GAIN = 3, 20.0
"""Differences of this order remove slow changes, such as the errors of a model; and their variance for white noise of
variance 1: 1 + 9 + 9 + 1.
"""
FLOOR = 0.1
"""Smallest noise, in assumed standard deviations of a measurement: simulated logs have only errors of integrators."""
_MULTIPLES = 0.98
"""Readings have a resolution if this share of their differences are multiples of it."""


@dataclass(frozen=True)
class Uncertainty:
    """How uncertain an estimate is.

    Attributes:
        scale_covariance: Shape ``(P, P)``, on the parameters' scales.
        standard_error: Shape ``(P,)``.
        low: Shape ``(P,)``: lower end of the 95 % interval, within the bounds.
        high: Shape ``(P,)``: upper end.
        state: That of each parameter, see ``OK``.
    """

    scale_covariance: np.ndarray
    standard_error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    state: tuple[str, ...]


def from_linearised(problem: Problem, at: Linearised) -> Uncertainty:
    """Return the uncertainty at a linearised point.

    The bounds act as a weak prior, so that an undetermined direction is as wide as its bounds, and not infinite.
    Residuals that are correlated in time carry less information: the variance is multiplied by (1 + rho) / (1 - rho),
    where rho is the correlation of successive residuals. If the model is wrong, that is still too small: standard
    errors then grow to the spread of the estimates without one part each.
    """
    table, J = problem.table, at.jacobian.reshape(-1, len(at.x))
    variance = loss_variance(problem, at)
    root = root_of_inverse(J.T @ J / variance + at.prior)
    spread = _of_covariance(table, at.x, root @ root.T, at)
    spread = between_parts(spread, table, at, *_without_blocks(at, variance))
    return _with_absent(spread, table, at, variance)


def _of_covariance(table: ParameterTable, x: np.ndarray, cov: np.ndarray, at: Linearised) -> Uncertainty:
    error, slope = np.sqrt(np.diag(cov)), table.slope(x)
    margin = np.minimum(x - table.low, table.high - x) / table.span
    reach = float(special.stdtrit(max(float(at.count), 3.0), 0.975))
    low, high = (table.unscale(x + sign * reach * error) for sign in (-1.0, 1.0))
    states = [
        BOUND if m < AT_BOUND else UNDETERMINED if e > VAGUE else OK
        for m, e in zip(margin, error / table.span, strict=True)
    ]
    return Uncertainty(cov, error * np.abs(slope), low, high, tuple(states))


def between_parts(
    spread: Uncertainty, table: ParameterTable, at: Linearised, moved: np.ndarray, share: np.ndarray
) -> Uncertainty:
    """Return wider intervals if estimates without a part of the recordings differ more than by chance.

    The standard error is that of the jackknife over parts (Efron and Stein, Annals of Statistics 9, 1981). If one part
    alone determines a parameter, its spread is unknown: its interval widens by the median factor of the other
    parameters.

    Args:
        moved: Shape ``(K, P)``: estimates without each part, on the parameters' scales.
        share: Shape ``(K, P)``: share of each part in the information about each parameter.
    """
    parts, errors = len(moved), np.sqrt(np.diag(spread.scale_covariance))
    if parts < _FEWEST:
        return spread
    error = np.sqrt((parts - 1) / parts * np.sum((moved - moved.mean(axis=0)) ** 2, axis=0))
    ratio, repeated = error / np.maximum(errors, 1e-30), share.max(axis=0) <= _ALONE
    if not repeated.any():
        return spread
    ratio = np.where(repeated, ratio, np.median(ratio[repeated]))
    begin, full = _BY_CHANCE
    weight = np.clip((begin - special.chdtrc(parts - 1.0, (parts - 1.0) * ratio**2)) / (begin - full), 0.0, 1.0)
    student = float(special.stdtrit(parts - 1.0, 0.975)) / 1.96
    factor = 1.0 + weight * (np.maximum(ratio * student, 1.0) - 1.0)
    # No standard error exceeds that of a uniform distribution within the bounds.
    factor = np.minimum(factor, np.maximum(1.0, table.span / np.sqrt(12.0) / np.maximum(errors, 1e-30)))
    wider = _of_covariance(table, at.x, spread.scale_covariance * np.outer(factor, factor), at)
    kept = [old if old in (ABSENT, NOT_REACHED) else new for old, new in zip(spread.state, wider.state, strict=True)]
    one_sided = np.isin(spread.state, (ABSENT, NOT_REACHED))
    low, high = np.where(one_sided, spread.low, wider.low), np.where(one_sided, spread.high, wider.high)
    return replace(wider, state=tuple(kept), low=low, high=high)


def _without_blocks(at: Linearised, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates without each block of segments ``(B, P)``, by a linear step, and the blocks' information."""
    edges = np.linspace(0, len(at.residuals), min(_BLOCKS, len(at.residuals)) + 1).astype(int)
    blocks = [at.of(np.arange(a, b)) for a, b in pairwise(edges)]
    rows = [(b.jacobian.reshape(-1, len(at.x)), b.residuals.reshape(-1)) for b in blocks]
    information = np.array([J.T @ J for J, _ in rows])
    gradient = np.array([J.T @ r for J, r in rows])
    left, pull = information.sum(axis=0) - information + at.prior * variance, gradient.sum(axis=0) - gradient
    moved = at.x - np.linalg.solve(left, pull[..., None])[..., 0]
    own = np.einsum("bpp->bp", information)
    return moved, own / np.maximum(own.sum(axis=0), 1e-300)


def _with_absent(spread: Uncertainty, table: ParameterTable, at: Linearised, variance: float) -> Uncertainty:
    """Return one-sided intervals of parameters that may be 0, and of limits that no motion reaches.

    On a logarithmic scale 0 is infinitely far away: the interval of an absent friction would be as wide as the bounds.
    Its effect is proportional to its value, so the derivative by the value gives an upper end. A limit that no motion
    reaches has no effect: all larger values are equally good, and the estimate stays nominal.
    """
    J, states, low, high = (
        at.jacobian.reshape(-1, len(at.x)),
        list(spread.state),
        spread.low.copy(),
        spread.high.copy(),
    )
    information, values, slope = J.T @ J / variance, table.unscale(at.x), np.abs(table.slope(at.x))
    prior, freely = at.prior, np.diag(at.prior)
    for i, p in enumerate(table.columns):
        if states[i] == OK or p.narrowed:
            continue
        if p.limits and information[i, i] * table.span[i] ** 2 < 1.0 / VAGUE**2:
            states[i], low[i], high[i] = NOT_REACHED, values[i], p.high
        elif p.vanishes or p.low == 0.0:
            loose = prior - np.diag(np.where(np.arange(len(at.x)) == i, freely * (1.0 - 1e-6), 0.0))
            root = root_of_inverse(information + loose)
            bound = values[i] + _ONE_SIDED * slope[i] * float(np.sqrt(root[i] @ root[i]))
            # Where others would vanish with it, as gain, friction and inertia without a known force, only ratios count.
            others = np.arange(len(at.x)) != i
            full = information + loose
            moved = np.linalg.solve(full[np.ix_(others, others)], full[others, i]) * values[i] / slope[i]
            logs = np.array([q.transform == "log" for q in table.columns])[others]
            if bound <= VAGUE * _ONE_SIDED * p.high and not (np.abs(moved[logs]) > _WITH_IT).any():
                states[i], low[i], high[i] = ABSENT, 0.0, bound
    return replace(spread, state=tuple(states), low=low, high=high)


def loss_variance(problem: Problem, at: Linearised) -> float:
    """Return the variance of a residual, larger if residuals are correlated in time."""
    count, free, inflation = _freedom(problem, at)
    return float(np.sum(at.residuals**2)) / max(count - free, 1) * inflation


def deviation(residuals: np.ndarray, compared: np.ndarray) -> float:
    """Return the standard deviation of a residual ``(S, K, F)``, larger if residuals are correlated in time.

    Args:
        compared: Shape ``(S, K)``, bool: which residuals count.
    """
    count = int(compared.sum()) * residuals.shape[-1]
    return float(np.sqrt(np.sum(residuals**2) / max(count, 1) * _inflation(residuals, compared)))


def _freedom(problem: Problem, at: Linearised) -> tuple[int, int, float]:
    """Return how many residuals there are, how many numbers were fitted, and the factor for correlation in time."""
    states = 2 * len(problem.channels) * len(at.residuals) * bool(problem.config.initial_state == "free")
    return at.count, len(at.x) + states, _inflation(at.residuals, at.compared)


def root_of_inverse(precision: np.ndarray) -> np.ndarray:
    """Return ``R (Q, Q)`` with ``R R' = precision^-1``, for a matrix that rounding may have made indefinite.

    The entries of a well measured and of a hardly measured parameter differ by more than doubles resolve: a plain
    inverse had negative variances.
    """
    unit = 1.0 / np.sqrt(np.diag(precision))
    values, axes = np.linalg.eigh(precision * np.outer(unit, unit))
    return unit[:, None] * axes / np.sqrt(np.maximum(values, _RESOLVED))


def _inflation(r: np.ndarray, compared: np.ndarray) -> float:
    """Return the factor on the variance for the correlation of successive residuals in segments, ``(E, C, F)``."""
    now, later = r[:, :-1], r[:, 1:]
    both = compared[:, :-1] & compared[:, 1:]
    rho = float(np.clip((now * later)[both].sum() / np.maximum((now**2)[both].sum(), 1e-12), 0.0, 0.95))
    return (1 + rho) / (1 - rho)


@dataclass(frozen=True)
class Determined:
    """Which parameters the data determines.

    Attributes:
        undetermined: Groups of parameters; the data determines at most combinations of each group.
        messages: The same as sentences.
        standard_error_per_minute: Parameter -> expected standard error after one minute of such data.
    """

    undetermined: tuple[tuple[str, ...], ...]
    messages: tuple[str, ...]
    standard_error_per_minute: Mapping[str, float]


def determined(problem: Problem, at: Linearised, without: Collection[str] = ()) -> Determined:
    """Return which parameters the data determines at a linearised point, if the only errors are noise.

    Args:
        without: Names of parameters that do not count, as they may be absent.
    """
    table = problem.table
    J = at.jacobian.reshape(-1, len(at.x)) * table.span  # per width of the bounds
    held = np.isin(table.names, list(without))
    J[:, held] = 0.0
    information = J.T @ J
    weights, axes = np.linalg.eigh(information)
    # Compute the standard errors that one minute of such data would give.
    prior = at.prior * np.outer(table.span, table.span)
    duration_s = problem.segment_s * len(problem.train)
    slope = np.abs(table.slope(at.x)) * table.span
    minute = np.sqrt(np.diag(np.linalg.inv(information * 60.0 / duration_s + prior))) * slope
    # Find the directions that the data does not determine, and the parameters that move together along them.
    open_axes = np.where(held[:, None], 0.0, axes)[:, weights < 1.0 / VAGUE**2]
    open_axes = open_axes[:, np.abs(open_axes).max(axis=0, initial=0.0) > 1e-9]
    groups, messages, alone = _groups(open_axes), [], []
    for group in groups:
        names = [table.names[i] for i in group]
        rank = int((np.linalg.svd(open_axes[group], compute_uv=False) > 0.05).sum())
        if rank < len(group):
            messages.append(f"only combinations of {', '.join(names)} are determined: fix {rank} of them")
        else:
            alone += names
    if alone:
        it = "it" if len(alone) == 1 else "them"
        messages.append(
            f"nothing in this data determines {', '.join(alone)}: excite {it}, fix {it} or give {it} a prior"
        )
    undetermined = tuple(tuple(table.names[i] for i in g) for g in groups)
    expected = dict(zip(table.names, minute.tolist(), strict=True))
    return Determined(undetermined, tuple(messages), expected)


def _groups(directions: np.ndarray) -> list[list[int]]:
    """Return which parameters move together along directions ``(P, k)`` that the data does not determine."""
    if not directions.shape[1]:
        return []
    spread = directions @ directions.T  # (P, P): the projection onto the directions, which no choice of basis changes
    part = np.sqrt(np.diag(spread))
    taking = part > _TAKES_PART * part.max()
    groups: list[list[int]] = []
    # Parameters that move together in an undetermined direction form a group.
    for i in np.flatnonzero(taking):
        for group in groups:
            if any(abs(spread[i, j]) > _TAKES_PART**2 * part[i] * part[j] for j in group):
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def compare_recordings(problem: Problem, at: Linearised) -> tuple[OverLogs, ...]:
    """Return for each quantity the estimates by each recording alone, and their spread.

    Each is a linear step from the estimate of all, so that recordings do not differ by the minimum that a search found.
    """
    table, alone = problem.table, []
    for segments in of_recordings(problem):
        own = at.of(segments)
        J, r = own.jacobian.reshape(-1, len(at.x)), own.residuals.reshape(-1)
        step = -np.linalg.solve(J.T @ J + at.prior * loss_variance(problem, at), J.T @ r)
        left = replace(own, residuals=own.residuals + own.jacobian @ step)
        root = root_of_inverse(J.T @ J / loss_variance(problem, left) + at.prior)
        alone.append((table.within(at.x + step), root @ root.T))
    rows = []
    for i, p in enumerate(table.columns):
        values = np.array([table.unscale(x)[i] for x, _ in alone])
        errors = np.array([np.sqrt(cov[i, i]) * abs(table.slope(x)[i]) for x, cov in alone])
        row = aggregate(values, errors, p.name, p.unit)
        rows.append(replace(row, low95=max(row.low95, p.low), high95=min(row.high95, p.high)))
    return tuple(rows)


def aggregate(estimates: np.ndarray, errors: np.ndarray, name: str = "", unit: str = "") -> OverLogs:
    """Combine estimates ``(K,)`` and their standard errors ``(K,)`` by a random-effects model (DerSimonian and Laird).

    The standard error of one recording does not include differences between recordings, due to temperature, wear, or
    errors of the model on other motions. The interval is the prediction interval of one further recording (Higgins,
    Thompson and Spiegelhalter, 2009), widened by the median standard error of a recording. Training randomises within
    this interval.
    """
    x, s = np.asarray(estimates, np.float64), np.maximum(np.asarray(errors, np.float64), 1e-30)
    if len(x) < 2:
        raise UsageError(f"an aggregate needs two recordings at least, got {len(x)}")
    # Weight each recording by its precision, and measure how much more they differ than these precisions explain.
    w = 1.0 / s**2
    fixed = float(np.sum(w * x) / np.sum(w))
    q = float(np.sum(w * (x - fixed) ** 2))
    surplus = float(np.sum(w) - np.sum(w**2) / np.sum(w))
    between = max(0.0, (q - (len(x) - 1)) / surplus)
    # Weight the recordings again, with the variance between them added.
    w = 1.0 / (s**2 + between)
    mean, error = float(np.sum(w * x) / np.sum(w)), float(np.sqrt(1.0 / np.sum(w)))
    reach = float(special.stdtrit(max(len(x) - 2, 1), 0.975)) * np.sqrt(between + error**2 + float(np.median(s**2)))
    return OverLogs(name, unit, mean, error, float(np.sqrt(between)), mean - reach, mean + reach)


def noises(samples: Mapping[str, np.ndarray], units: Mapping[str, str]) -> tuple[Noise, ...]:
    """Return the noise of each measured quantity around the identified model.

    Third differences of the residuals separate white noise from slow errors of the model.

    Args:
        samples: Columns of the segments; see ``Identification.samples``.
        units: Column, or field of a message -> unit.
    """
    rows = []
    for name in (n.removesuffix("_measured") for n in samples if n.endswith("_measured")):
        measured = samples[f"{name}_measured"]
        # Split the residuals by segment, without diverged values.
        parts = [
            (measured - samples[f"{name}_identified"])[rows]
            for rows in (samples["segment"] == s for s in np.unique(samples["segment"]))
        ]
        parts = [p[np.isfinite(p)] for p in parts]
        parts = [p for p in parts if p.size > _ORDER]
        if not parts:
            continue
        quantum = _quantum(measured[np.isfinite(measured)])
        white = np.concatenate([np.diff(p, _ORDER) for p in parts])
        # Subtract the variance of rounding, as the simulation rounds readings, too.
        variance = max(0.0, float(np.mean(white**2)) / _GAIN - quantum**2 / 12.0)
        # Estimate the bias: the variance of the segments' means, less the part that noise explains.
        means = np.array([p.mean() for p in parts])
        expected = float(np.mean([p.var() / p.size for p in parts]))
        bias = max(0.0, float(np.mean(means**2)) - expected)
        unit = units.get(name) or units.get(name.partition("[")[0], "")
        rows.append(Noise(name, unit, variance**0.5, quantum, bias**0.5))
    return tuple(rows)


def widening(at: Linearised, spread: Uncertainty) -> float:
    """Return the factor on the posterior's standard deviations with which predictions cover the model's errors.

    The posterior becomes narrow with long recordings, even if no parameters explain them: a robot that the model does
    not describe acts, from moment to moment, like a robot with other parameters. With this factor, the predictions of
    draws spread on average as widely as the slow part of the residuals. White noise does not count.
    """
    inside = np.broadcast_to(at.compared[:, None], at.raw.transpose(0, 2, 1).shape)
    total, white, count = (each.sum() for each in _squares(at))
    slow = max(0.0, total - white) / count if count else 0.0
    # Compare the slow residuals with the spread of the predictions.
    J = at.jacobian.transpose(0, 2, 1, 3)[inside]
    predicted = float(np.einsum("np,pq,nq->n", J, spread.scale_covariance, J).mean()) if J.size else 0.0
    return float(np.sqrt(1.0 + slow / predicted)) if predicted > 0.0 else 1.0


def above_noise(at: Linearised) -> float:
    """Return the largest ratio of a field's residuals to the noise of the sensor, which no model predicts."""
    total, white, count = _squares(at)
    if not count.any():
        return np.inf
    return float(np.sqrt(np.max(total / np.maximum(white, FLOOR**2 * np.maximum(count, 1)))))


def _squares(at: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sum of squares of each field's residuals, the share of white noise in it, and their number, ``(F,)``.

    Third differences separate white noise from slow errors.
    """
    rows = np.zeros((3, at.raw.shape[-1]))
    for field in range(at.raw.shape[-1]):
        parts = [r[counts] for r, counts in zip(at.raw[..., field], at.compared, strict=True)]
        parts = [r for r in parts if r.size > _ORDER]
        if parts:
            white = float(np.mean(np.concatenate([np.diff(r, _ORDER) for r in parts]) ** 2)) / _GAIN
            squares = np.concatenate(parts) ** 2
            rows[:, field] = squares.sum(), min(white, float(squares.mean())) * squares.size, squares.size
    return rows[0], rows[1], rows[2]


def _quantum(readings: Sequence[float] | np.ndarray) -> float:
    """Return the resolution of readings: the step that divides nearly all their differences; 0 without such a step."""
    levels = np.unique(np.asarray(readings, np.float64))
    steps = np.diff(levels)
    steps = steps[steps > 1e-6 * max(1e-12, float(np.ptp(levels)))] if levels.size > 1 else np.zeros(0)
    if steps.size < 8:
        return 0.0
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    off = np.abs(steps / step - np.round(steps / step))
    return step if np.mean(off < 0.05) >= _MULTIPLES else 0.0
