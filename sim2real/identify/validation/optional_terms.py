"""Which optional terms a model needs: chosen by how well data that was left out is explained.

Around the estimate of the widest model the loss of every part of the recordings is a quadratic function of the
parameters. The loss of any smaller model, fitted to some parts and judged on another, follows from those by linear
algebra; a term that matters little is close to where it is left out, and there the approximation is good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.uncertainty import Linearised

_RESAMPLED = 1000
"""How often recordings are drawn anew."""
_FAR, _DIVERGED = 3.0, 1e100
"""A set whose error is so many times that of one of its subsets is never chosen; the mean square of what diverged."""
_RARE = 0.02
"""A model that is chosen less often is no alternative."""


@dataclass(frozen=True)
class Statistics:
    """The loss of K parts of the recordings around a point, as quadratic functions of the parameters' scales.

    Attributes:
        x: Shape ``(P,)``: the point.
        value: Shape ``(K,)``: sums of squares there.
        gradient: Shape ``(K, P)``: half the gradients.
        information: Shape ``(K, P, P)``: half the second derivatives.
        prior: Shape ``(P, P)``: what priors and bounds add to the information of all parts.
        count: Shape ``(K,)``: how many measurements each part holds.
    """

    x: np.ndarray
    value: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    prior: np.ndarray
    count: np.ndarray

    def step(
        self, table: ParameterTable, kept: np.ndarray, left_out: int | None = None, bounded: bool = False
    ) -> np.ndarray:
        """Return the step to the estimate of a smaller model from all parts, or all but one, ``(P,)``.

        Args:
            kept: Shape ``(T,)``, bool: which terms are part of the model.
            left_out: Number of the part that is left out; None: none is.
            bounded: Whether parameters that would leave their bounds stop there, and the others go where that is best.
        """
        place = {name: i for i, name in enumerate(table.terms)}
        step, gone = np.zeros(len(self.x)), np.zeros(len(self.x), bool)
        for i, column in enumerate(table.columns):
            p = column.parameter
            if p.term and not kept[place[p.term]]:
                gone[i] = True
                step[i] = p.to_scale(min(max(p.without, p.low), p.high)) - self.x[i]
        g, H = self.gradient.sum(axis=0), self.information.sum(axis=0) + self.prior
        if left_out is not None:
            g, H = g - self.gradient[left_out], H - self.information[left_out]
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
        """Return the same without one part."""
        return self._of(np.delete(np.arange(len(self.value)), part))

    def only(self, part: int) -> Statistics:
        """Return the same of one part alone."""
        return self._of(np.array([part]))

    def _of(self, rows: np.ndarray) -> Statistics:
        return Statistics(
            self.x, self.value[rows], self.gradient[rows], self.information[rows], self.prior, self.count[rows]
        )


@dataclass(frozen=True)
class Selection:
    """What was chosen.

    Attributes:
        kept: Shape ``(T,)``, bool: which of the table's terms.
        order: The terms in the order in which they were left out, the least needed first.
        excess: Shape ``(T + 1,)``: mean square on what was left out, over that of the best of these models, as terms
            are left out one after the other; the first entry is the widest model's.
        error: Shape ``(T + 1,)``: standard error of ``excess``.
        near: Shape ``(M, T)``, bool: all models that were tried and are within a standard error of the best, the chosen
            one first; which terms they have.
        weight: Shape ``(M,)``: how often each of them would be chosen; adds up to 1.
    """

    kept: np.ndarray
    order: tuple[str, ...]
    excess: np.ndarray
    error: np.ndarray
    near: np.ndarray
    weight: np.ndarray

    def names(self, table: ParameterTable) -> tuple[str, ...]:
        """Return the names of the terms that were chosen."""
        return tuple(n for n, kept in zip(table.terms, self.kept, strict=True) if kept)


def statistics(problem: Problem, at: Linearised, parts: np.ndarray) -> Statistics:
    """Return the loss of parts of the recordings around a point.

    Args:
        at: The point; of fitted segments only.
        parts: Shape ``(K, S)``, bool: which fitted segments belong to each part.
    """
    size = len(at.x)
    rows = [(at.residuals[own].reshape(-1), at.jacobian[own].reshape(-1, size)) for own in parts]
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
    """Leave out terms one after the other, each time the one that is missed least, and say where to stop.

    Chosen is the smallest model that is worse than the best one by no more than one standard error of the difference
    between parts (Breiman et al., Classification and Regression Trees, 1984): a term that helps in a single part has a
    standard error as large as its gain, and is left out. With other recordings like these the same rule would choose
    now this model, now that: see ``votes``.

    Args:
        stats: The loss of at least two parts.
        table: The parameters, those of all terms free.
        among: Shape ``(T,)``, bool: the terms to choose from, the others are left out; default: all.
    """
    names = table.terms
    kept = np.ones(len(names), bool) if among is None else among.copy()
    path, scores, order = [kept.copy()], [_left_out(stats, table, kept)], []
    aside: list[tuple[np.ndarray, np.ndarray]] = []
    while kept.any():
        trials = {}
        for t in np.flatnonzero(kept):
            fewer = kept.copy()
            fewer[t] = False
            trials[int(t)] = (_left_out(stats, table, fewer), fewer)
        least = min(trials, key=lambda t: float(trials[t][0].mean()))
        aside += [one for t, one in trials.items() if t != least]
        score, kept = trials[least][0], trials[least][1].copy()
        path.append(kept.copy())
        scores.append(score)
        order.append(names[least])
    smallest, best, excess, error = _smallest(np.array(scores))
    models = np.array([path[smallest], *path[:smallest], *path[smallest + 1 :], *(m for _, m in aside)])
    every = np.array([scores[smallest], *scores[:smallest], *scores[smallest + 1 :], *(s for s, _ in aside)])
    share = votes(every, models.sum(axis=1)) * np.less_equal(*_excess(every, best))
    near = np.flatnonzero((share >= _RARE) | (np.arange(len(share)) == 0))
    return Selection(path[smallest], tuple(order), excess, error, models[near], share[near] / share[near].sum())


def votes(scores: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return in which share of recordings like these each model would be chosen, ``(M,)``.

    Frequencies of selection over resampled data are weights that hold what choosing itself leaves open (Buckland,
    Burnham and Augustin, Biometrics 53, 1997). Parts are few, so their shares are drawn (the Bayesian bootstrap of
    Rubin, Annals of Statistics 9, 1981). Weights by likelihood would all go to one model: residuals are thousands, and
    far from independent.

    Args:
        scores: Shape ``(M, K)``: mean square of each model on each part.
        size: Shape ``(M,)``: how many terms each has; of models within a standard error of the best the smallest wins.
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


def narrowed(choice: Selection, table: ParameterTable, scores: np.ndarray, errors: np.ndarray) -> Selection:
    """Return a choice after the chosen set, and smaller ones, were fitted and judged on what was left out.

    The quadratic functions of ``choose`` are those around the widest model's estimate. Where that did not converge, or
    far from it, they are wrong: on a linear axis they made a set of two terms out of one that was ten times better.

    Args:
        scores: Shape ``(M, K)``: mean squares on each part, of the sets of ``below``, the smallest first.
        errors: Shape ``(M, E)``: root mean square errors of each set, of any kinds.
    """
    order = slice(None, None, -1)  # the largest first
    sets, errors = np.array(below(choice, table))[order], np.nan_to_num(errors[order], nan=np.inf)
    chosen = _smallest(np.nan_to_num(scores[order], nan=_DIVERGED, posinf=_DIVERGED))[0]
    for smaller in range(chosen + 1, len(sets)):
        if np.any(errors[chosen] > _FAR * errors[smaller]):
            chosen = smaller
    if not chosen:
        return choice
    return replace(choice, kept=sets[chosen], near=sets[chosen][None], weight=np.ones(1))


def below(choice: Selection, table: ParameterTable) -> list[np.ndarray]:
    """Return the chosen set and the smaller ones to which it was reduced, ``(T,)`` each, the smallest first."""
    kept, found = choice.kept.copy(), [choice.kept.copy()]
    for name in choice.order:
        if kept[table.terms.index(name)]:
            kept[table.terms.index(name)] = False
            found.append(kept.copy())
    return found[::-1]


def _smallest(scores: np.ndarray) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Return the smallest model within a standard error of the best, the best's scores ``(K,)``, excesses and errors.

    Args:
        scores: Shape ``(M, K)``: mean squares on each part, of the largest model first.
    """
    best = scores[int(np.argmin(scores.mean(axis=1)))]
    excess, error = _excess(scores, best)
    return int(np.flatnonzero(excess <= error)[-1]), best, excess, error


def _excess(scores: np.ndarray, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how much worse models ``(M, K)`` are than the best ``(K,)``, and the standard errors of that; ``(M,)``."""
    off = scores - best
    return off.mean(axis=1), off.std(axis=1, ddof=1) / np.sqrt(len(best))


def _left_out(stats: Statistics, table: ParameterTable, kept: np.ndarray) -> np.ndarray:
    """Return the mean square on each part when it is left out of the fit, ``(K,)``, for a model with some terms."""
    found = []
    for k in range(len(stats.value)):
        step = stats.step(table, kept, k)
        own = stats.value[k] + 2.0 * stats.gradient[k] @ step + step @ stats.information[k] @ step
        found.append(own / stats.count[k])
    return np.array(found)
