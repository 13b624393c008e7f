"""Covariance and intervals of the parameters by the recordings, and parameters that they do not determine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Data
from sim2real.later import special

VAGUE = 0.15
"""Standard errors above this share of the bounds' width are not identifiable (a uniform distribution has 0.29)."""
AT_BOUND = 0.005
"""An estimate within this share of the bounds' width of a bound counts as at the bound."""
_BLOCK_S = 1.0
"""Residuals further apart than this count as independent [s]."""
_BLOCKS = 20
"""How many blocks there are at least, where the recordings are long enough: fewer leave too few degrees of freedom."""
_INSIDE = 5e-3
"""Share of the bounds' width from a bound within which derivatives are taken further inside: a servo's by a delay of up
to 20 ms were mostly rounding at 1e-4 of it."""
_RESOLVED = 1e-13
"""Least eigenvalue of a precision with a diagonal of ones: smaller ones are rounding errors of doubles."""
_LEAST_FREEDOM = 2.0
"""With fewer degrees of freedom Satterthwaite's approximation fails: Tipton, Psychological Methods 20 (2015)."""
_ALONE, _WHOLLY = 0.5, 0.9
"""Share of the information about a parameter of one part that determines it, and of one that leaves no variance."""
_BY_CHANCE = (0.2, 0.05)
"""Intervals begin to widen where chance alone would make blocks differ as much in this share of recordings, and widen
in full in this one: a sharp limit doubled an interval, or did not, by the last digits of a fit."""


@dataclass(frozen=True)
class Linearised:
    """Residuals and their Jacobian at a point, on the parameters' scales.

    Attributes:
        residuals: Shape ``(S, C, F)``.
        jacobian: Shape ``(S, C, F, P)``: d residual / d scale.
        prior: Shape ``(P, P)``: precision that priors and bounds add; the bounds' is that of a uniform distribution.
        x: Shape ``(P,)``: the point.
        raw: Shape ``(S, C, F)``: the residuals without a robust loss.
        compared: Shape ``(S, C)``, bool: where a measurement was compared, as an exact residual is 0, too; default: in
            all places.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray
    x: np.ndarray
    raw: np.ndarray
    compared: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))

    def __post_init__(self) -> None:
        if not self.compared.size:
            object.__setattr__(self, "compared", np.ones(self.residuals.shape[:2], bool))

    @property
    def count(self) -> int:
        """Number of residuals."""
        return int(self.compared.sum()) * self.residuals.shape[-1]


@dataclass(frozen=True)
class Uncertainty:
    """How uncertain an estimate is.

    Attributes:
        covariance: Shape ``(P, P)``, of the values, in their units.
        scale_covariance: Shape ``(P, P)``, on the parameters' scales.
        standard_error: Shape ``(P,)``.
        low: Shape ``(P,)``: lower end of the 95 % interval, within the bounds.
        high: Shape ``(P,)``: upper end.
        verdict: One a parameter: ``accepted``, ``negligible``, ``not reached``, ``not identifiable`` or ``at a bound``.
        correlation: Shape ``(P, P)``.
        inflation: Factor on the variance for residuals that are correlated in time.
        misfit: Root mean square of the residuals in deviations of the measurement, without a robust loss: 1 where the
            model explains everything but the noise.
        widening: Shape ``(P,)``: factor on the linearised standard error where blocks of the recordings disagree, with
            Student's factor for the number of blocks; 1 where they disagree no more than by chance.
    """

    covariance: np.ndarray
    scale_covariance: np.ndarray
    standard_error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    verdict: tuple[str, ...]
    correlation: np.ndarray
    inflation: float
    misfit: float
    widening: np.ndarray


def linearise(problem: Problem, z: np.ndarray, data: Data | None = None) -> Linearised:
    """Compute residuals and Jacobian at a point.

    At a bound nothing changes with ``z`` any more, but it does with the parameter: there both are computed at a point a
    little inside, and the residuals carried on to the estimate along the Jacobian.

    Args:
        z: Shape ``(P,)``: the point.
        data: Segments to fit; default: all fitted ones.
    """
    table = problem.table
    most = np.log((1.0 - _INSIDE) / _INSIDE)
    inside = np.clip(z, -most, most)
    evaluation = problem.at(inside, data)
    at, stretch = table.scale(inside)
    x, J = table.scale(z)[0], evaluation.jacobian / stretch
    onward = J @ (x - at)
    priors = evaluation.prior_jacobian / stretch
    prior = priors.T @ priors + np.diag(12.0 / table.span**2)
    compared = problem.compared(data)
    return Linearised(evaluation.residuals + onward, J, prior, x, evaluation.raw + onward, compared)


def uncertainty(problem: Problem, z: np.ndarray) -> Uncertainty:
    """Return the uncertainty of the estimate ``z (P,)``."""
    return from_linearised(problem, linearise(problem, z))


def from_linearised(problem: Problem, at: Linearised) -> Uncertainty:
    """Return the uncertainty at a linearised point.

    The bounds act as a weak prior, so that a direction which the log does not determine gets the width of its bounds
    and not infinity. Residuals that are correlated in time carry less information than their number: the variance is
    scaled by (1 + rho) / (1 - rho), rho their correlation from one sample to the next. Where the model is wrong, that
    is still too small: standard errors then grow to what the estimate varies by between blocks of the recordings, but
    only where blocks differ more than by chance, as a standard error from a few blocks is itself off by a fifth.
    """
    # Covariance of a linear model with white noise.
    table, size = problem.table, len(at.x)
    J, (count, free, inflation) = at.jacobian.reshape(-1, size), _freedom(problem, at)
    variance = loss_variance(problem, at)
    root = root_of_inverse(J.T @ J / variance + at.prior)
    cov = root @ root.T
    # Widen the errors to those between blocks of the log.
    quantile = float(special.stdtrit(max(count / inflation - free, 1.0), 0.975))
    linear = np.sqrt(np.diag(cov))
    error, freedom = _by_blocks(*_blocks(problem, at), at.prior * variance)
    wider = _widening(error / linear, freedom, quantile, freedom >= _LEAST_FREEDOM)
    # No standard error grows beyond that of a uniform distribution within the bounds.
    wider = np.minimum(wider, np.maximum(1.0, table.span / np.sqrt(12.0) / np.maximum(linear, 1e-30)))
    cov *= np.outer(wider, wider)
    error = np.sqrt(np.diag(cov))
    low, high = (table.unscale(at.x + sign * quantile * error) for sign in (-1.0, 1.0))
    # Return to the parameters' own scales.
    slope = table.slope(at.x)
    margin = np.minimum(at.x - table.low, table.high - at.x) / table.span
    return Uncertainty(
        covariance=cov * np.outer(slope, slope),
        scale_covariance=cov,
        standard_error=error * np.abs(slope),
        low=low,
        high=high,
        verdict=tuple(_verdict(e, m) for e, m in zip(error / table.span, margin, strict=True)),
        correlation=cov / np.outer(error, error),
        inflation=inflation,
        misfit=float(np.sqrt(np.sum(at.raw**2) / max(count, 1))),
        widening=wider,
    )


def loss_variance(problem: Problem, at: Linearised) -> float:
    """Return the variance of a residual, larger where residuals are correlated in time."""
    count, free, inflation = _freedom(problem, at)
    return float(np.sum(at.residuals**2)) / max(count - free, 1) * inflation


def deviation(residuals: np.ndarray, compared: np.ndarray) -> float:
    """Return the deviation of a residual ``(S, K, F)``, larger where residuals are correlated in time.

    Args:
        compared: Shape ``(S, K)``, bool: which residuals count.
    """
    count = int(compared.sum()) * residuals.shape[-1]
    return float(np.sqrt(np.sum(residuals**2) / max(count, 1) * _inflation(residuals, compared)))


def _freedom(problem: Problem, at: Linearised) -> tuple[int, int, float]:
    """Return how many residuals there are, how many numbers were fitted, and the factor for correlation in time."""
    states = 2 * len(problem.channels) * len(at.residuals) * bool(problem.config.initial_state == "free")
    return at.count, len(at.x) + states, _inflation(at.residuals, at.compared)


def between_parts(
    spread: Uncertainty, table: ParameterTable, x: np.ndarray, moved: np.ndarray, share: np.ndarray
) -> Uncertainty:
    """Return wider intervals if estimates without a part of the recordings differ more than by chance.

    The standard error is that of the jackknife over parts (Efron and Stein, Annals of Statistics 9, 1981). Parts are
    recordings, or long blocks, and show differences that shorter blocks do not show. If one part has more information
    about a parameter than all others together, its interval widens as that of the median parameter.

    Args:
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        moved: Shape ``(K, P)``: estimates without each part, on the scales.
        share: Shape ``(K, P)``: share of each part in the information about each parameter.
    """
    parts = len(moved)
    error = np.sqrt((parts - 1) / parts * np.sum((moved - moved.mean(axis=0)) ** 2, axis=0))
    errors = np.sqrt(np.diag(spread.scale_covariance))
    ratio, repeated = error / np.maximum(errors, 1e-30), share.max(axis=0) <= _ALONE
    factor = _widening(ratio, np.full(len(x), parts - 1.0), float(special.stdtrit(1e3, 0.975)), repeated)
    factor = np.minimum(factor, np.maximum(1.0, table.span / np.sqrt(12.0) / np.maximum(errors, 1e-30)))
    return scaled(spread, table, x, factor)


def scaled(spread: Uncertainty, table: ParameterTable, x: np.ndarray, factor: np.ndarray) -> Uncertainty:
    """Return intervals that are wider by a factor each.

    Args:
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        factor: Shape ``(P,)``: on standard errors and on the reach of intervals.
    """
    # Widen on the parameters' scales, then return to their units.
    cov = spread.scale_covariance * np.outer(factor, factor)
    middle = np.array([c.parameter.to_scale(v) for c, v in zip(table.columns, table.unscale(x), strict=True)])
    low, high = (
        np.array([c.parameter.to_scale(v) for c, v in zip(table.columns, ends, strict=True)])
        for ends in (spread.low, spread.high)
    )
    margin = np.minimum(x - table.low, table.high - x) / table.span
    error = np.sqrt(np.diag(cov))
    return replace(
        spread,
        covariance=spread.covariance * np.outer(factor, factor),
        scale_covariance=cov,
        standard_error=spread.standard_error * factor,
        low=table.unscale(middle - factor * (middle - low)),
        high=table.unscale(middle + factor * (high - middle)),
        verdict=tuple(_verdict(e, m) for e, m in zip(error / table.span, margin, strict=True)),
        widening=spread.widening * factor,
    )


def sum_of(spread: Uncertainty, columns: list[int]) -> float:
    """Return the standard error of the sum of some values [their unit]."""
    return float(np.sqrt(max(spread.covariance[np.ix_(columns, columns)].sum(), 0.0)))


def _verdict(error: float, margin: float) -> str:
    """Judge by standard error and distance from the nearer bound, both as shares of the bounds' width.

    An estimate at a bound is reported as that, even if it is vague as well.
    """
    if margin < AT_BOUND:
        return "at a bound"
    return "not identifiable" if error > VAGUE else "accepted"


def _blocks(problem: Problem, at: Linearised) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient ``(B, P)`` and information ``(B, P, P)`` of blocks of the recordings.

    A block is a segment, or several in a row where there are many, to include slower changes. Segments are split only
    where they are few: parts that share an initial state are not independent.
    """
    segments, places = at.residuals.shape[:2]
    parts = min(-(-_BLOCKS // segments), max(1, int(problem.segment_s / _BLOCK_S)))
    edges = np.linspace(0, places, parts + 1).astype(int)
    gradients, informations = [], []
    for s in range(segments):
        for a, b in pairwise(edges):
            J = at.jacobian[s, a:b].reshape(-1, len(at.x))
            gradients.append(J.T @ at.residuals[s, a:b].reshape(-1))
            informations.append(J.T @ J)
    firsts = np.arange(0, len(gradients), max(1, segments // _BLOCKS))
    return np.add.reduceat(gradients, firsts), np.add.reduceat(informations, firsts)


def _by_blocks(gradients: np.ndarray, informations: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard errors ``(Q,)`` that blocks show, and their degrees of freedom ``(Q,)``.

    The variance is the sum of squares of the blocks' effects on the estimate, for any correlation of residuals within
    a block (a "sandwich" estimate). The fit follows blocks of large weight, so their residuals are too
    small: they are scaled up so that the variance is unbiased for white noise (Bell and McCaffrey, Survey Methodology
    28, 2002). A bootstrap over blocks was 1.15 times too large with ten blocks that differ.

    Args:
        gradients: Shape ``(B, Q)``.
        informations: Shape ``(B, Q, Q)``.
        prior: Shape ``(Q, Q)``: information of the prior.
    """
    root = root_of_inverse(informations.sum(axis=0) + prior)
    shares = root.T @ informations @ root  # their sum is the identity, minus the prior's share
    left, axes = np.linalg.eigh(np.eye(len(root)) - shares)
    scaled = (axes / np.sqrt(np.maximum(left, 1e-3))[:, None, :]) @ axes.transpose(0, 2, 1)
    moves = np.einsum("pq,bqr->pbr", root, scaled)
    variance = np.sum(np.einsum("pbr,br->pb", moves, gradients @ root) ** 2, axis=1)
    # Satterthwaite's degrees of freedom, from the covariance that white noise gives the moves of blocks.
    pulls = np.einsum("pbr,brs->pbs", moves, shares)
    diagonal = np.einsum("pbr,pbr->pb", pulls, moves)[:, :, None] * np.eye(len(shares))
    between = diagonal - pulls @ pulls.transpose(0, 2, 1)
    trace, square = np.trace(between, axis1=1, axis2=2), np.sum(between**2, axis=(1, 2))
    # The estimate follows a block that alone determines a parameter, so no variance is left.
    content = np.einsum("pq,bqr,pr->bp", root, shares, root)
    wholly = content.max(axis=0) > _WHOLLY * content.sum(axis=0)
    return np.sqrt(variance), np.where(wholly, 0.0, trace**2 / np.maximum(square, 1e-300))


def root_of_inverse(precision: np.ndarray) -> np.ndarray:
    """Return ``R (Q, Q)`` with ``R R' = precision^-1``, for a matrix that rounding may have made indefinite.

    A quantity with a million measurements and one with bounds alone differ by more than doubles resolve: a plain
    inverse had negative variances there.
    """
    unit = 1.0 / np.sqrt(np.diag(precision))
    values, axes = np.linalg.eigh(precision * np.outer(unit, unit))
    return unit[:, None] * axes / np.sqrt(np.maximum(values, _RESOLVED))


def _widening(ratio: np.ndarray, freedom: np.ndarray, quantile: float, repeated: np.ndarray) -> np.ndarray:
    """Return factors by which intervals widen, ``(Q,)``.

    A parameter that one block determines does not show how much it would differ in others: it widens as the median
    parameter. Without that, its intervals held the truth in 26 to 75 % of simulated recordings of a wrong model.

    Args:
        ratio: Shape ``(Q,)``: standard error by blocks over the linearised one.
        freedom: Shape ``(Q,)``: degrees of freedom of the former.
        quantile: Factor on the latter for an interval of 95 %.
        repeated: Shape ``(Q,)``, bool: whether several blocks determine a parameter.
    """
    if not repeated.any():
        return np.ones_like(ratio)
    ratio, freedom = (np.where(repeated, v, np.median(v[repeated])) for v in (ratio, freedom))
    begin, full = _BY_CHANCE
    share = np.clip((begin - special.chdtrc(freedom, freedom * ratio**2)) / (begin - full), 0.0, 1.0)
    return 1.0 + share * (np.maximum(ratio * special.stdtrit(freedom, 0.975) / quantile, 1.0) - 1.0)


def _inflation(r: np.ndarray, compared: np.ndarray) -> float:
    """Return the factor on the variance for the correlation of successive residuals in segments, ``(E, C, F)``."""
    now, later = r[:, :-1], r[:, 1:]
    both = compared[:, :-1] & compared[:, 1:]
    rho = float(np.clip((now * later)[both].sum() / np.maximum((now**2)[both].sum(), 1e-12), 0.0, 0.95))
    return (1 + rho) / (1 - rho)
