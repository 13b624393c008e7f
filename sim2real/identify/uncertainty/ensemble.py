"""Models that explain the recordings as well as the estimate: other terms, and other optima of the search."""

from dataclasses import replace

import numpy as np

from sim2real.artifacts.posterior import Alternative, Posterior
from sim2real.identify.fit import Fit
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.negligible import ABSENT, NOT_REACHED
from sim2real.identify.uncertainty.uncertainty import (
    Linearised,
    Uncertainty,
    from_linearised,
    linearise,
    loss_variance,
)
from sim2real.identify.validation.optional_terms import Selection

_WORSE = 0.1
"""Relative excess of the loss above which a model explains the recordings less well."""
_GAIN = 1e-3
"""Relative gain of the loss at which the descent of such a model ends; to the minimum, those of an arm took 270 s."""


def posterior(
    estimate: Fit, at: Linearised, spread: Uncertainty, widest: Fit, selection: Selection | None
) -> Posterior:
    """Return the estimate with its uncertainty, and the models that explain the recordings as well.

    Args:
        widest: The estimate with all optional terms.
        selection: How terms were selected; None without a selection.
    """
    # Possible values, other optima, and models with other optional terms.
    table = estimate.problem.table
    distribution = _possible(table.posterior(estimate.z, spread.scale_covariance), table, spread)
    optima = _optima(estimate, at, spread)
    models = [] if selection is None else _models(widest, estimate, spread, selection)
    if not optima and not models:
        return distribution
    # The estimate has the weight that the others do not have.
    left = 1.0 - sum(m.weight for m in models)
    others = (*(replace(o, weight=o.weight * left) for o in optima), *models)
    names = dict.fromkeys(n for p in (distribution, *(o.posterior for o in others)) for n in p.names)
    without = {c.label: c.parameter.without for c in widest.problem.table.columns}

    def filled(p: Posterior) -> Posterior:
        return replace(p, without={n: without[n] for n in names if n not in p.names})

    return replace(filled(distribution), others=tuple(replace(o, posterior=filled(o.posterior)) for o in others))


def _optima(estimate: Fit, at: Linearised, spread: Uncertainty) -> list[Alternative]:
    """Return the ends of the refinement from other starts between which the recordings do not decide.

    Such an end lies outside the uncertainty of the estimate, and its loss is larger by one standard error of the
    difference between segments at most. All optima have the same share.
    """
    problem, table = estimate.problem, estimate.problem.table
    near, score, posteriors = [at.x], _by_segment(at.residuals, at.compared), []
    # Compare without absent parameters: all values on one side of their bound explain the recordings alike.
    informed = np.flatnonzero([v not in ABSENT for v in spread.verdict])
    precision = np.linalg.pinv(spread.scale_covariance[np.ix_(informed, informed)])

    def apart(x: np.ndarray) -> bool:
        return all(float(d @ precision @ d) > len(d) for d in ((x - other)[informed] for other in near))

    def as_good(residuals: np.ndarray) -> bool:
        off = _by_segment(residuals, at.compared) - score
        return len(off) > 1 and bool(off.mean() <= off.std(ddof=1) / np.sqrt(len(off)))

    # Test each end by a linear step first, as a refinement takes longer.
    for z, loss in estimate.refined[-1].ends if estimate.refined else ():
        if not loss <= (1.0 + _WORSE) * estimate.loss or not apart(table.scale(z)[0]):
            continue
        x, residuals = _descended(linearise(problem, z))
        if not (apart(x) and as_good(residuals)):
            continue
        # Refine the end further, as the estimate was refined after the first round.
        z = refine(problem, z[None], settle=False).z
        end = linearise(problem, z)
        if apart(end.x) and as_good(end.residuals):
            near.append(end.x)
            posteriors.append(table.posterior(z, from_linearised(problem, end).scale_covariance))
    return [Alternative("another optimum", 1.0 / len(near), p) for p in posteriors]


def _descended(at: Linearised) -> tuple[np.ndarray, np.ndarray]:
    """Return the end of the next Gauss-Newton step, on the parameters' scales ``(P,)``, and the residuals there."""
    J = at.jacobian.reshape(-1, len(at.x))
    step = -np.linalg.solve(J.T @ J + at.prior, J.T @ at.residuals.reshape(-1))
    return at.x + step, at.residuals + at.jacobian @ step


def _models(widest: Fit, estimate: Fit, spread: Uncertainty, selection: Selection) -> list[Alternative]:
    """Return the models with other terms that recordings like these might select."""
    problem, table = widest.problem, widest.problem.table
    models = []
    for trial, weight in zip(selection.near[1:], selection.weight[1:], strict=True):
        present, columns = trial.present, table.of_terms(trial.present)
        # Refine each other model from its rough fit, and keep those with a similar loss.
        data, rest = problem.part(present=columns), np.flatnonzero(columns)
        z = refine(problem, trial.z[None], data, settle=False, gain=_GAIN).z
        if problem.loss(z, data) > (1.0 + _WORSE) * estimate.loss:
            continue
        # Compute its covariance, widened like the estimate's.
        at = linearise(problem, z, data)
        J = at.jacobian.reshape(-1, len(at.x))
        precision = J.T @ J / loss_variance(problem, at) + at.prior
        fewer = ParameterTable([p for p in table if p.free], table.recordings).with_terms(_named(table, present))
        covariance = _widened(np.linalg.inv(precision[np.ix_(rest, rest)]), fewer, estimate.problem.table, spread)
        drawn = _possible(fewer.posterior(z[rest], covariance), estimate.problem.table, spread)
        models.append(Alternative(_about(table, present), float(weight), drawn))
    return models


def _possible(posterior: Posterior, table: ParameterTable, spread: Uncertainty) -> Posterior:
    """Return a posterior without the values of limits that the recordings exclude."""
    low = posterior.low.copy()
    for name, column, verdict, bound in zip(table.names, table.columns, spread.verdict, spread.low, strict=True):
        if verdict == NOT_REACHED and name in posterior.names:
            i = posterior.names.index(name)
            low[i] = min(column.parameter.to_scale(float(bound)), posterior.mean[i])
    return replace(posterior, low=low)


def _widened(covariance: np.ndarray, table: ParameterTable, fewer: ParameterTable, spread: Uncertainty) -> np.ndarray:
    """Return a covariance that is wider than its linearisation by the factor of the estimate's covariance.

    Args:
        covariance: Shape ``(Q, Q)``, linearised.
    """
    deviation, usual = np.sqrt(np.diag(covariance)), float(np.median(spread.widening))
    factor = np.full(len(deviation), usual)
    for i, name in enumerate(table.names):
        if name in fewer.names:
            j = fewer.names.index(name)
            ratio = float(np.sqrt(spread.scale_covariance[j, j]) / deviation[i])
            factor[i] = min(ratio, usual) if spread.verdict[j] in ABSENT else spread.widening[j]
    factor = np.minimum(factor, np.maximum(1.0, table.span / np.sqrt(12.0) / deviation))
    return covariance * np.outer(factor, factor)


def _by_segment(residuals: np.ndarray, compared: np.ndarray) -> np.ndarray:
    """Return the mean square of the residuals ``(S, C, F)`` of each segment, ``(S,)``."""
    return np.sum(residuals**2, axis=(1, 2)) / np.maximum(compared.sum(axis=1) * residuals.shape[-1], 1)


def _named(table: ParameterTable, present: np.ndarray) -> list[str]:
    return [name for name, there in zip(table.terms, present, strict=True) if there]


def _about(table: ParameterTable, present: np.ndarray) -> str:
    return f"with {', '.join(_named(table, present))}" if present.any() else "without optional terms"
