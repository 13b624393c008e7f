"""Selection of the optional terms of a model, by the errors on held-out parts.

Around an estimate the loss of every part of the recordings is a quadratic function of the parameters. The estimate
without a part, and that of a model with other terms, follow by linear algebra. They are starts and proposals; errors
that decide are simulated (``term_trials``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.identification import HeldOutPart
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.uncertainty import Linearised

_RESAMPLED = 1000
"""Number of resampled sets of recordings."""
_FAR, _DIVERGED = 1.5, 1e100
"""Ratio of a set's error to that of a subset above which the set is not selected; mean square of a diverged
prediction."""
ALIKE = 1.1
"""Largest ratio of two errors that count as equal."""
_RARE = 0.02
"""Share of selections below which a model is no alternative."""


@dataclass(frozen=True)
class Statistics:
    """The loss of K parts of the recordings around a point, as quadratic functions of the parameters' scales.

    Attributes:
        x: Shape ``(P,)``: the point.
        value: Shape ``(K,)``: sums of squares there.
        gradient: Shape ``(K, P)``: half the gradients.
        information: Shape ``(K, P, P)``: half the second derivatives.
        prior: Shape ``(P, P)``: information of priors and bounds.
        count: Shape ``(K,)``: number of measurements of each part.
    """

    x: np.ndarray
    value: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    prior: np.ndarray
    count: np.ndarray

    def step(
        self, table: ParameterTable, present: np.ndarray, held_out: np.ndarray | None = None, bounded: bool = False
    ) -> np.ndarray:
        """Return the step to the estimate of a smaller model from all parts, or all but some, ``(P,)``.

        Args:
            present: Shape ``(T,)``, bool: the terms of the model.
            held_out: Shape ``(K,)``, bool: the held-out parts; None: all parts are used.
            bounded: Whether parameters stop at their bounds, and the others are optimised with these values.
        """
        # Move the parameters of absent terms to their values without effect.
        place = {name: i for i, name in enumerate(table.terms)}
        step, gone = np.zeros(len(self.x)), np.zeros(len(self.x), bool)
        for i, column in enumerate(table.columns):
            p = column.parameter
            if p.term and not present[place[p.term]]:
                gone[i] = True
                step[i] = p.to_scale(min(max(p.without, p.low), p.high)) - self.x[i]
        # Sum the quadratic functions of the parts.
        g, H = self.gradient.sum(axis=0), self.information.sum(axis=0) + self.prior
        if held_out is not None:
            g, H = g - self.gradient[held_out].sum(axis=0), H - self.information[held_out].sum(axis=0)
        # Solve for the other parameters; stop those that leave their bounds, and solve again.
        for _ in range(len(self.x)):
            rest = np.flatnonzero(~gone)
            step[rest] = 0.0
            step[rest] = -np.linalg.solve(H[np.ix_(rest, rest)], (g + H @ step)[rest])
            end = self.x + step
            beyond = ~gone & ((end < table.low) | (end > table.high))
            if not bounded or not beyond.any():
                break
            step[beyond] = (np.clip(end, table.low, table.high) - self.x)[beyond]
            gone |= beyond
        return step

    def only(self, part: int) -> Statistics:
        """Return the statistics of one part."""
        one = slice(part, part + 1)
        rows = self.value[one], self.gradient[one], self.information[one]
        return Statistics(self.x, *rows, self.prior, self.count[one])


@dataclass(frozen=True)
class Trial:
    """The fit of one set of optional terms.

    Attributes:
        present: Shape ``(T,)``, bool: the terms.
        z: Shape ``(P,)``: the estimate; parameters of absent terms have their values without the term.
        loss: Loss of the estimate.
        stats: The loss of each part around the estimate, by the parameters of the set.
        rows: The estimates without each part, and their errors on it.
        ahead: Shape ``(K,)``: mean square of the errors up to the horizon on each part, with that part held out.
        free: Shape ``(K,)``: the same in free runs; zeros without free runs.
        above: Ratio of the residuals to the noise of the sensor, which no set predicts.
        judged: Whether the fit ended, and the errors are those of refits where it matters; if not, of linear steps.
    """

    present: np.ndarray
    z: np.ndarray
    loss: float
    stats: Statistics
    rows: Sequence[HeldOutPart]
    ahead: np.ndarray
    free: np.ndarray
    above: float = np.inf
    judged: bool = True

    def names(self, table: ParameterTable) -> tuple[str, ...]:
        """Return the names of the terms."""
        return tuple(n for n, present in zip(table.terms, self.present, strict=True) if present)


@dataclass(frozen=True)
class Selection:
    """A selection of terms.

    Attributes:
        near: The selected set, then other sets within a standard error of the best.
        weight: Shape ``(M,)``: share of resampled recordings that select each of them; the sum is 1.
        by_part: For each part the set that the errors on the other parts select among the subsets of the selected one.
        trials: All sets that were fitted.
    """

    near: tuple[Trial, ...]
    weight: np.ndarray
    by_part: tuple[Trial, ...]
    trials: tuple[Trial, ...] = ()

    def names(self, table: ParameterTable) -> tuple[str, ...]:
        """Return the names of the selected terms."""
        return self.near[0].names(table)


def statistics(problem: Problem, at: Linearised, parts: np.ndarray) -> Statistics:
    """Return the loss of parts of the recordings around a point.

    Args:
        at: The point, for the fitted segments.
        parts: Shape ``(K, S)``, bool: the fitted segments of each part.
    """
    size = len(at.x)
    rows = [(at.residuals[mask].reshape(-1), at.jacobian[mask].reshape(-1, size)) for mask in parts]
    variance = float(np.sum(at.residuals**2)) / max(at.count, 1)
    return Statistics(
        x=at.x,
        value=np.array([r @ r for r, _ in rows]),
        gradient=np.array([J.T @ r for r, J in rows]),
        information=np.array([J.T @ J for _, J in rows]),
        prior=at.prior * variance,
        count=np.array([max(int(at.compared[m].sum()) * len(at.raw[0, 0]), 1) for m in parts], np.float64),
    )


def select(trials: Sequence[Trial]) -> Selection:
    """Return the selected set, and its alternatives.

    ``votes`` resamples the recordings, as others might select another set.

    Args:
        trials: The fits of sets of terms, among them that of no term.
    """
    chosen = selected(trials)
    below = [t for t in trials if _within(t, chosen)]
    parts = np.arange(len(chosen.ahead))
    by_part = tuple(selected(below, parts != k) if len(parts) > 2 else chosen for k in parts)
    # Weigh the sets within a standard error of the best.
    possible = [chosen, *(t for t in trials if t is not chosen and not _worse_than_a_subset(t, trials))]
    scores = np.array([_finite(t.ahead) for t in possible])
    best = scores[int(np.argmin(scores.mean(axis=1)))]
    share = votes(scores, np.array([t.present.sum() for t in possible])) * _as_good(scores, best)
    near = np.flatnonzero((share >= _RARE) | (np.arange(len(share)) == 0))
    weight = np.maximum(share[near], _RARE)
    return Selection(tuple(possible[i] for i in near), weight / weight.sum(), by_part, tuple(trials))


def selected(trials: Sequence[Trial], parts: np.ndarray | None = None) -> Trial:
    """Return the smallest set whose errors are within one standard error of the best set's, or within ten percent.

    The standard error is that of the difference between parts (Breiman et al., Classification and Regression Trees,
    1984). A term that helps in a single part has a standard error as large as its gain, and is not selected. A set is
    not selected either if a subset has far smaller errors, up to the horizon or in free runs: its fit ended anywhere.

    Args:
        parts: Shape ``(K,)``, bool: the parts whose errors count; default: all.
    """
    possible = [t for t in trials if not _worse_than_a_subset(t, trials, parts)]
    scores = np.array([_finite(t.ahead if parts is None else t.ahead[parts]) for t in possible])
    best = scores[int(np.argmin(scores.mean(axis=1)))]
    within = _as_good(scores, best)
    order = np.lexsort((scores.mean(axis=1), [t.present.sum() for t in possible], ~within))
    return possible[order[0]]


def _worse_than_a_subset(trial: Trial, trials: Sequence[Trial], parts: np.ndarray | None = None) -> bool:
    """Return whether an error of a set is far above that of one of its subsets."""

    def errors(t: Trial) -> np.ndarray:
        some = slice(None) if parts is None else parts
        return np.sqrt([_finite(t.ahead[some]).mean(), _finite(t.free[some]).mean()])

    return any(_within(t, trial) and t is not trial and np.any(errors(trial) > _FAR * errors(t)) for t in trials)


def _within(trial: Trial, other: Trial) -> bool:
    """Return whether a set is a subset of another."""
    return not np.any(trial.present & ~other.present)


def _finite(squares: np.ndarray) -> np.ndarray:
    return np.nan_to_num(squares, nan=_DIVERGED, posinf=_DIVERGED)


def votes(scores: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the share of resampled recordings that selects each model, ``(M,)``.

    Frequencies of selection over resampled data are weights that include the uncertainty of the selection (Buckland,
    Burnham and Augustin, Biometrics 53, 1997). Parts are few, so their shares are drawn (the Bayesian bootstrap of
    Rubin, Annals of Statistics 9, 1981). Likelihoods would give all weight to one model, as thousands of residuals are
    correlated.

    Args:
        scores: Shape ``(M, K)``: mean square of each model on each part.
        size: Shape ``(M,)``: number of terms; of the models as good as the best, the smallest wins.
    """
    models, parts = scores.shape
    rng = np.random.default_rng(0)
    chosen = np.zeros(models)
    for share in (np.full(parts, 1.0 / parts), *rng.dirichlet(np.ones(parts), _RESAMPLED)):
        mean = scores @ share
        off = scores - scores[np.argmin(mean)]
        excess = off @ share
        error = np.sqrt((off - excess[:, None]) ** 2 @ share / (parts - 1))
        within = (excess <= error) | (np.sqrt(mean) <= ALIKE * np.sqrt(mean.min()))
        chosen[np.lexsort((mean, size, ~within))[0]] += 1.0
    return chosen / chosen.sum()


def _as_good(scores: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Return which models ``(M, K)`` are as good as the best ``(K,)``, ``(M,)``, bool."""
    off = scores - best
    error = off.std(axis=1, ddof=1) / np.sqrt(len(best))
    return (off.mean(axis=1) <= error) | ~better(best, scores)


def better(squares: np.ndarray, than: np.ndarray) -> np.ndarray:
    """Return whether mean squares ``(..., K)`` are lower than others by more than the ratio of equal errors."""
    return np.sqrt(squares.mean(axis=-1)) * ALIKE < np.sqrt(than.mean(axis=-1))


def on_held_out_parts(stats: Statistics, table: ParameterTable, present: np.ndarray) -> np.ndarray:
    """Return the mean square on each part with that part held out of the fit, ``(K,)``, for a model with some terms."""
    scores = []
    parts = np.arange(len(stats.value))
    for k in parts:
        step = stats.step(table, present, parts == k, bounded=True)
        square = stats.value[k] + 2.0 * stats.gradient[k] @ step + step @ stats.information[k] @ step
        scores.append(square / stats.count[k])
    return np.array(scores)
