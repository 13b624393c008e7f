"""Selection of the optional terms of a model, by the errors on held-out parts.

Around the estimate of the widest model the loss of every part of the recordings is a quadratic function of the
parameters. The loss of any smaller model, fitted to some parts and judged on another, follows by linear algebra. A term
that matters little is near its value without effect, where the approximation is good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.uncertainty import Linearised

_RESAMPLED = 1000
"""Number of resampled sets of recordings."""
_FAR, _DIVERGED = 3.0, 1e100
"""Ratio of a set's error to that of a subset above which the set is not selected; mean square of a diverged
prediction."""
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
        self, table: ParameterTable, kept: np.ndarray, held_out: int | None = None, bounded: bool = False
    ) -> np.ndarray:
        """Return the step to the estimate of a smaller model from all parts, or all but one, ``(P,)``.

        Args:
            kept: Shape ``(T,)``, bool: the terms of the model.
            held_out: Number of the held-out part; None: all parts are used.
            bounded: Whether parameters stop at their bounds, and the others are optimised with these values.
        """
        # Move the parameters of absent terms to their values without effect.
        place = {name: i for i, name in enumerate(table.terms)}
        step, gone = np.zeros(len(self.x)), np.zeros(len(self.x), bool)
        for i, column in enumerate(table.columns):
            p = column.parameter
            if p.term and not kept[place[p.term]]:
                gone[i] = True
                step[i] = p.to_scale(min(max(p.without, p.low), p.high)) - self.x[i]
        # Sum the quadratic functions of the parts.
        g, H = self.gradient.sum(axis=0), self.information.sum(axis=0) + self.prior
        if held_out is not None:
            g, H = g - self.gradient[held_out], H - self.information[held_out]
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

    def without(self, part: int) -> Statistics:
        """Return the statistics without one part."""
        return self._of(np.delete(np.arange(len(self.value)), part))

    def only(self, part: int) -> Statistics:
        """Return the statistics of one part."""
        return self._of(np.array([part]))

    def _of(self, rows: np.ndarray) -> Statistics:
        return Statistics(
            self.x, self.value[rows], self.gradient[rows], self.information[rows], self.prior, self.count[rows]
        )


@dataclass(frozen=True)
class Selection:
    """A selection of terms.

    Attributes:
        kept: Shape ``(T,)``, bool: which of the table's terms.
        order: The terms in the order of their removal, the least needed first.
        excess: Shape ``(T + 1,)``: mean square on held-out parts above that of the best model, as terms are removed one
            after the other; the first entry is the widest model's.
        error: Shape ``(T + 1,)``: standard error of ``excess``.
        near: Shape ``(M, T)``, bool: terms of the models within a standard error of the best, the selected one first.
        weight: Shape ``(M,)``: share of resampled recordings that select each model; the sum is 1.
    """

    kept: np.ndarray
    order: tuple[str, ...]
    excess: np.ndarray
    error: np.ndarray
    near: np.ndarray
    weight: np.ndarray

    def names(self, table: ParameterTable) -> tuple[str, ...]:
        """Return the names of the selected terms."""
        return tuple(n for n, kept in zip(table.terms, self.kept, strict=True) if kept)


def statistics(problem: Problem, at: Linearised, parts: np.ndarray) -> Statistics:
    """Return the loss of parts of the recordings around a point.

    Args:
        at: The point, for the fitted segments.
        parts: Shape ``(K, S)``, bool: the fitted segments of each part.
    """
    size = len(at.x)
    rows = [(at.residuals[mask].reshape(-1), at.jacobian[mask].reshape(-1, size)) for mask in parts]
    variance = float(np.sum(at.residuals**2)) / max(np.count_nonzero(at.residuals), 1)
    return Statistics(
        x=at.x,
        value=np.array([r @ r for r, _ in rows]),
        gradient=np.array([J.T @ r for r, J in rows]),
        information=np.array([J.T @ J for _, J in rows]),
        prior=at.prior * variance,
        count=np.array([max(np.count_nonzero(r), 1) for r, _ in rows], np.float64),
    )


def choose(stats: Statistics, table: ParameterTable, among: np.ndarray | None = None) -> Selection:
    """Remove terms one after the other, each time the least needed, and select the smallest sufficient model.

    The selected model is the smallest one whose excess over the best model is within one standard error of the
    difference between parts (Breiman et al., Classification and Regression Trees, 1984). A term that helps in a single
    part has a standard error as large as its gain, and is removed. ``votes`` resamples the recordings, as others might
    select another model.

    Args:
        stats: The loss of at least two parts.
        table: The parameters, those of all terms free.
        among: Shape ``(T,)``, bool: the terms to select from; the others are removed; default: all.
    """
    names = table.terms
    kept = np.ones(len(names), bool) if among is None else among.copy()
    path, scores, order = [kept.copy()], [_on_held_out_parts(stats, table, kept)], []
    others: list[tuple[np.ndarray, np.ndarray]] = []
    # Remove the term whose removal costs least, until none is present.
    while kept.any():
        trials = {}
        for t in np.flatnonzero(kept):
            fewer = kept.copy()
            fewer[t] = False
            trials[int(t)] = (_on_held_out_parts(stats, table, fewer), fewer)
        least = min(trials, key=lambda t: float(trials[t][0].mean()))
        others += [one for t, one in trials.items() if t != least]
        score, kept = trials[least][0], trials[least][1].copy()
        path.append(kept.copy())
        scores.append(score)
        order.append(names[least])
    # Select the smallest model near the best, and weigh all models that were tried.
    smallest, best, excess, error = _smallest(np.array(scores))
    models = np.array([path[smallest], *path[:smallest], *path[smallest + 1 :], *(m for _, m in others)])
    all_scores = np.array([scores[smallest], *scores[:smallest], *scores[smallest + 1 :], *(s for s, _ in others)])
    share = votes(all_scores, models.sum(axis=1)) * np.less_equal(*_excess(all_scores, best))
    near = np.flatnonzero((share >= _RARE) | (np.arange(len(share)) == 0))
    return Selection(path[smallest], tuple(order), excess, error, models[near], share[near] / share[near].sum())


def votes(scores: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the share of resampled recordings that selects each model, ``(M,)``.

    Frequencies of selection over resampled data are weights that include the uncertainty of the selection (Buckland,
    Burnham and Augustin, Biometrics 53, 1997). Parts are few, so their shares are drawn (the Bayesian bootstrap of
    Rubin, Annals of Statistics 9, 1981). Likelihoods would give all weight to one model, as thousands of residuals are
    correlated.

    Args:
        scores: Shape ``(M, K)``: mean square of each model on each part.
        size: Shape ``(M,)``: number of terms; of the models within a standard error of the best, the smallest wins.
    """
    models, parts = scores.shape
    rng = np.random.default_rng(0)
    chosen = np.zeros(models)
    for share in (np.full(parts, 1.0 / parts), *rng.dirichlet(np.ones(parts), _RESAMPLED)):
        mean = scores @ share
        off = scores - scores[np.argmin(mean)]
        excess = off @ share
        error = np.sqrt((off - excess[:, None]) ** 2 @ share / (parts - 1))
        within = excess <= error
        chosen[np.lexsort((mean, size, ~within))[0]] += 1.0
    return chosen / chosen.sum()


def narrowed(selection: Selection, table: ParameterTable, scores: np.ndarray, errors: np.ndarray) -> Selection:
    """Return a selection after refits of the selected set and smaller ones.

    The quadratic functions of ``choose`` are wrong if the widest model's estimate did not converge, or far from it: on
    a linear axis they selected two terms whose error was ten times that of one.

    Args:
        scores: Shape ``(M, K)``: mean squares on each part, of the sets of ``below``, the smallest first.
        errors: Shape ``(M, E)``: root mean square errors of each set, of any kinds.
    """
    order = slice(None, None, -1)  # the largest first
    sets, errors = np.array(below(selection, table))[order], np.nan_to_num(errors[order], nan=np.inf)
    chosen = _smallest(np.nan_to_num(scores[order], nan=_DIVERGED, posinf=_DIVERGED))[0]
    for smaller in range(chosen + 1, len(sets)):
        if np.any(errors[chosen] > _FAR * errors[smaller]):
            chosen = smaller
    if not chosen:
        return selection
    return replace(selection, kept=sets[chosen], near=sets[chosen][None], weight=np.ones(1))


def below(selection: Selection, table: ParameterTable) -> list[np.ndarray]:
    """Return the selected set and the smaller ones of its reduction, ``(T,)`` each, the smallest first."""
    kept, sets = selection.kept.copy(), [selection.kept.copy()]
    for name in selection.order:
        if kept[table.terms.index(name)]:
            kept[table.terms.index(name)] = False
            sets.append(kept.copy())
    return sets[::-1]


def _smallest(scores: np.ndarray) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Return the smallest model within a standard error of the best, the best's scores ``(K,)``, excesses and errors.

    Args:
        scores: Shape ``(M, K)``: mean squares on each part, of the largest model first.
    """
    best = scores[int(np.argmin(scores.mean(axis=1)))]
    excess, error = _excess(scores, best)
    return int(np.flatnonzero(excess <= error)[-1]), best, excess, error


def _excess(scores: np.ndarray, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the excess of models ``(M, K)`` over the best ``(K,)``, and its standard error; both ``(M,)``."""
    off = scores - best
    return off.mean(axis=1), off.std(axis=1, ddof=1) / np.sqrt(len(best))


def _on_held_out_parts(stats: Statistics, table: ParameterTable, kept: np.ndarray) -> np.ndarray:
    """Return the mean square on each part with that part held out of the fit, ``(K,)``, for a model with some terms."""
    scores = []
    for k in range(len(stats.value)):
        step = stats.step(table, kept, k)
        square = stats.value[k] + 2.0 * stats.gradient[k] @ step + step @ stats.information[k] @ step
        scores.append(square / stats.count[k])
    return np.array(scores)
