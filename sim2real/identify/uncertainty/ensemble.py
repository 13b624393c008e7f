"""Models that explain the recordings as well as the estimate: other terms, and other optima of the search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim2real.artifacts.estimation.posterior import Alternative, Posterior
from sim2real.identify.fit import Fit
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.negligible import ABSENT, NOT_REACHED
from sim2real.identify.uncertainty.uncertainty import (
    Linearised,
    Uncertainty,
    centred,
    from_linearised,
    linearise,
    loss_variance,
)
from sim2real.identify.validation.optional_terms import Selection, statistics

_WORSE = 0.1
"""A model whose loss is larger by this share explains the recordings less well, whatever an approximation said."""


def posterior(found: Fit, at: Linearised, spread: Uncertainty, every: Fit, choice: Selection | None) -> Posterior:
    """Return the estimate with its uncertainty, and the models that explain the recordings as well.

    Args:
        every: The estimate with all optional terms, from which the estimate's were chosen.
        choice: What was chosen; None: nothing was to be chosen.
    """
    table = found.problem.table
    own = _possible(table.posterior(found.z, spread.scale_covariance), table, spread)
    optima = _optima(found, at, spread)
    models = [] if choice is None else _models(every, found, spread, choice)
    if not optima and not models:
        return own
    left = 1.0 - sum(m.weight for m in models)
    others = (*(replace(o, weight=o.weight * left) for o in optima), *models)
    names = dict.fromkeys(n for p in (own, *(o.posterior for o in others)) for n in p.names)
    without = {c.label: c.parameter.without for c in every.problem.table.columns}

    def filled(p: Posterior) -> Posterior:
        return replace(p, without={n: without[n] for n in names if n not in p.names})

    return replace(filled(own), others=tuple(replace(o, posterior=filled(o.posterior)) for o in others))


def _optima(found: Fit, at: Linearised, spread: Uncertainty) -> list[Alternative]:
    """Return where other starts of the refinement ended, as far as the recordings leave open which is right.

    That is: elsewhere than the uncertainty of the estimate admits, and worse by no more than one standard error of the
    difference between segments. Then nothing tells them apart, and all have the same share.
    """
    problem, table = found.problem, found.problem.table
    near, score, kept = [at.x], _by_segment(at.residuals), []
    # Of what may as well be absent, any value on its side of the bound is the same.
    told = np.flatnonzero([v not in ABSENT for v in spread.verdict])
    precision = np.linalg.pinv(spread.scale_covariance[np.ix_(told, told)])

    def apart(x: np.ndarray) -> bool:
        return all(float(d @ precision @ d) > len(d) for d in ((x - other)[told] for other in near))

    def as_good(residuals: np.ndarray) -> bool:
        off = _by_segment(residuals) - score
        return len(off) > 1 and bool(off.mean() <= off.std(ddof=1) / np.sqrt(len(off)))

    for z, loss in found.refined[-1].ends if found.refined else ():
        if not loss <= (1.0 + _WORSE) * found.loss or not apart(table.scale(centred(table, z))[0]):
            continue
        x, residuals = _descended(linearise(problem, centred(table, z)))
        if not (apart(x) and as_good(residuals)):
            continue
        # The estimate went on after the first round; so must what is compared with it.
        z = refine(problem, z[None], settle=False).z
        there = linearise(problem, z)
        if apart(there.x) and as_good(there.residuals):
            near.append(there.x)
            kept.append(table.posterior(z, from_linearised(problem, there).scale_covariance))
    return [Alternative("another optimum", 1.0 / len(near), p) for p in kept]


def _descended(at: Linearised) -> tuple[np.ndarray, np.ndarray]:
    """Return where the next step of a descent leads, on the parameters' scales ``(P,)``, and the residuals there."""
    J = at.jacobian.reshape(-1, len(at.x))
    step = -np.linalg.solve(J.T @ J + at.prior, J.T @ at.residuals.reshape(-1))
    return at.x + step, at.residuals + at.jacobian @ step


def _models(every: Fit, found: Fit, spread: Uncertainty, choice: Selection) -> list[Alternative]:
    """Return the models with other terms that recordings like these might have chosen."""
    problem, table = every.problem, every.problem.table
    at = linearise(problem, every.z)
    whole = statistics(problem, at, np.ones((1, len(problem.train)), bool))
    precision = whole.information[0] / loss_variance(problem, at) + at.prior
    models = []
    for kept, weight in zip(choice.near[1:], choice.weight[1:], strict=True):
        own = table.of_terms(kept)
        start = table.at_scale(at.x + whole.step(table, kept))
        ended = refine(problem, start[None], problem.part(kept=own), settle=False)
        if ended.loss > (1.0 + _WORSE) * found.loss:
            continue
        z, rest = ended.z, np.flatnonzero(own)
        fewer = ParameterTable([p for p in table if p.free], table.recordings).with_terms(_named(table, kept))
        covariance = _widened(np.linalg.inv(precision[np.ix_(rest, rest)]), fewer, found.problem.table, spread)
        drawn = _possible(fewer.posterior(z[rest], covariance), found.problem.table, spread)
        models.append(Alternative(_about(table, kept), float(weight), drawn))
    return models


def _possible(posterior: Posterior, table: ParameterTable, spread: Uncertainty) -> Posterior:
    """Return a posterior without those values of limits that the recordings rule out."""
    low = posterior.low.copy()
    for name, column, verdict, bound in zip(table.names, table.columns, spread.verdict, spread.low, strict=True):
        if verdict == NOT_REACHED and name in posterior.names:
            i = posterior.names.index(name)
            low[i] = min(column.parameter.to_scale(float(bound)), posterior.mean[i])
    return replace(posterior, low=low)


def _widened(covariance: np.ndarray, table: ParameterTable, known: ParameterTable, spread: Uncertainty) -> np.ndarray:
    """Return a covariance that is as much wider than its linearisation as that of the estimate.

    Args:
        covariance: Shape ``(Q, Q)``, linearised.
    """
    deviation, usual = np.sqrt(np.diag(covariance)), float(np.median(spread.widening))
    factor = np.full(len(deviation), usual)
    for i, name in enumerate(table.names):
        if name in known.names:
            j = known.names.index(name)
            ratio = float(np.sqrt(spread.scale_covariance[j, j]) / deviation[i])
            factor[i] = min(ratio, usual) if spread.verdict[j] in ABSENT else spread.widening[j]
    factor = np.minimum(factor, np.maximum(1.0, table.span / np.sqrt(12.0) / deviation))
    return covariance * np.outer(factor, factor)


def _by_segment(residuals: np.ndarray) -> np.ndarray:
    """Return the mean square of the residuals ``(S, C, F)`` of each segment, ``(S,)``."""
    rows = residuals.reshape(len(residuals), -1)
    return np.sum(rows**2, axis=1) / np.maximum(np.count_nonzero(rows, axis=1), 1)


def _named(table: ParameterTable, kept: np.ndarray) -> list[str]:
    return [name for name, there in zip(table.terms, kept, strict=True) if there]


def _about(table: ParameterTable, kept: np.ndarray) -> str:
    return f"with {', '.join(_named(table, kept))}" if kept.any() else "without optional terms"
