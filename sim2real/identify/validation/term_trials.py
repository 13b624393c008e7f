"""Fits of sets of optional terms, from no term upwards, and their errors on held-out parts.

A fit with many terms may end before its minimum. A set therefore begins at the end of a smaller one and cannot end with
a larger loss, and the choice compares simulations of the sets, not approximations of the largest one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sim2real.identify.fit import INSIDE, Fit, opened
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.segments import Data
from sim2real.identify.problem.thinned import MOST_OF_SETS, thinned
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.noise import above_noise
from sim2real.identify.uncertainty.uncertainty import Linearised, linearise
from sim2real.identify.validation import folds
from sim2real.identify.validation.optional_terms import (
    ALIKE,
    Statistics,
    Trial,
    better,
    on_held_out_parts,
    selected,
    statistics,
)
from sim2real.identify.validation.prediction import labels
from sim2real.identify.validation.refits import Refits

_SHARES = (1.0, 0.25, 0.06)
"""Shares of the linear step without a part that are simulated; the best begins the descent without that part."""
_GAIN = 1e-3
"""Relative gain of the loss at which a descent without a part ends."""
_CLEAR = 2.0
"""Ratio of a set's loss to the least loss from which the set is clearly worse: descents without parts are skipped."""
LITTLE = 0.01
"""Share of the loss below which a further term gains too little for refits without parts: they could not gain 5 %."""
_LEVELS, _ACTS, _LOWER = 16, 1e-4, 2
"""Levels of a limit that are simulated; relative change of the loss from which it acts; the second start's number of
levels below the first."""
_LIMITED = 2.0
"""Ratio of residuals to noise from which limits are tried: one that acts leaves far more, and its fit takes long."""
_TRIED = 3
"""Most larger sets that are fitted in a round."""
_WORSE = 0.02
"""Relative excess of the loss over that of a smaller set above which a fit did not converge."""
Attempt = Callable[[np.ndarray, Sequence[np.ndarray], float], Trial]
"""Fits a set of terms ``(T,)`` from starts ``(P,)``; a converged fit has at most the loss of a smaller set."""
Limited = Callable[[Trial, np.ndarray], Sequence[np.ndarray]]
"""Returns starts ``(P,)`` at which the limit that a set has beyond a trial's acts."""


def grown(
    attempt: Attempt,
    wider: Callable[[Trial], Statistics],
    table: ParameterTable,
    starts: Sequence[np.ndarray],
    limited: Limited = lambda trial, present: (),
    needed: Sequence[int] = (),
    least: float = np.inf,
    judge: Callable[[Trial], Trial] = lambda trial: trial,
) -> list[Trial]:
    """Return the fits of sets of terms: none, then larger ones as long as held-out parts are predicted better.

    Each round fits sets with one or two further terms that the quadratic approximation around the smaller set proposes,
    and with the terms that the fit of all terms needs. Then the subsets of the selected set are fitted that lack
    one of its terms.

    Args:
        wider: Returns the loss of each part around a fit, by the parameters of all terms.
        starts: Starts of the fit without terms, ``(P,)`` each.
        limited: A limit that does not act has no derivative, so no approximation proposes it: it gets its own starts.
        needed: Terms that the fit of all terms needs, the most needed one first: where a model without a term ends far
            away, as one that compensates no weight, an approximation around it proposes another term.
        least: Loss of the fit of all terms; a set that is clearly worse is tried with all needed terms at a time.
        judge: Ends a fit, and returns its errors by refits: only the best of a round, and the selected set, need them.
    """
    none = np.zeros(len(table.terms), bool)
    base = judge(attempt(none, starts, np.inf))
    trials, limits = [base], table.of_limits()
    # Add terms until the errors on held-out parts stay, or only noise is left.
    while not base.present.all() and base.above > ALIKE:
        stats, level = wider(base), list[Trial]()
        lacks = [i for i in needed if not base.present[i]]
        first = [base.present | np.isin(np.arange(len(none)), some) for some in (lacks, lacks[:1]) if some]
        first = first if len(lacks) > 1 and base.loss > _CLEAR * least else first[1:]
        proposed = [p for p in _proposed(stats, table, base.present) if not any(np.array_equal(p, q) for q in first)]
        for present in [*first, *proposed]:
            if len(level) > 1 and better(_best(level).ahead, base.ahead):
                break
            begins = [_begin(stats, table, present), opened(table, base.z, present), *starts]
            level.append(_with_gain(attempt(present, begins, base.loss), base))
        _judge_best(level, judge)
        # Try the limits once no other term helps: the fit of one costs a descent from each of several levels.
        helped = bool(level) and better(_best(level).ahead, base.ahead)
        for i in () if helped or base.above < _LIMITED else np.flatnonzero(limits & ~base.present):
            present = base.present | (np.arange(len(none)) == i)
            level.append(_with_gain(attempt(present, limited(base, present), base.loss), base))
            limits[i] = level[-1].loss < (1.0 - LITTLE) * base.loss
        _judge_best(level, judge)
        trials += level
        if not level or not better(_best(level).ahead, base.ahead):
            break
        base = _best(level)
    return _with_subsets(trials, attempt, table, judge)


def _with_subsets(
    trials: list[Trial], attempt: Attempt, table: ParameterTable, judge: Callable[[Trial], Trial]
) -> list[Trial]:
    """Return trials with the fits of the selected set without each of its terms, until no subset is left."""
    while True:
        while not (chosen := selected(trials)).judged:
            trials[_place(trials, chosen)] = judge(chosen)
        there = {t.present.tobytes() for t in trials}
        fewer = [chosen.present & (np.arange(len(table.terms)) != i) for i in np.flatnonzero(chosen.present)]
        lacking = [present for present in fewer if present.tobytes() not in there]
        if not lacking:
            return trials
        for present in lacking:
            below = min((t for t in trials if not np.any(t.present & ~present)), key=lambda t: t.loss)
            begins = [_begin(chosen.stats, table, present), opened(table, below.z, present)]
            trials.append(_with_gain(attempt(present, begins, below.loss), below))


def _judge_best(level: list[Trial], judge: Callable[[Trial], Trial]) -> None:
    """Judge the best trial, until the best of them is judged."""
    while level and not (best := _best(level)).judged:
        level[_place(level, best)] = judge(best)


def _place(trials: Sequence[Trial], trial: Trial) -> int:
    return next(i for i, t in enumerate(trials) if t is trial)


def _with_gain(trial: Trial, below: Trial) -> Trial:
    """Return a trial; with the errors of a smaller set if its loss is the same, as a limit that nothing reaches has.

    Such a set gets no refits, and the errors of linear steps are not comparable with those of refits.
    """
    if (1.0 - LITTLE) * below.loss <= trial.loss <= (1.0 + _WORSE) * below.loss:
        return replace(trial, rows=below.rows, ahead=below.ahead, free=below.free, judged=True)
    return trial


def _proposed(stats: Statistics, table: ParameterTable, present: np.ndarray, pairs: bool = True) -> list[np.ndarray]:
    """Return larger sets in the order in which they are fitted, ``(T,)`` each, by their predicted errors.

    The first has one further term. The others have two, if that is better, or another one, if it is better than none.
    """
    absent, place = np.flatnonzero(~present & ~table.of_limits()), np.arange(len(present))
    if not len(absent):
        return []

    def ordered(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
        sets = [present | np.isin(place, more) for more in combinations(absent, count)]
        scored = [(one, on_held_out_parts(stats, table, one)) for one in sets]
        return sorted(scored, key=lambda pair: float(pair[1].mean()))

    (first, score), *ones = ordered(1)
    none = on_held_out_parts(stats, table, present)
    twos = [pair for pair in (ordered(2)[:1] if pairs else []) if better(pair[1], score)]
    return [first, *(one for one, error in (*twos, *ones) if better(error, none))][:_TRIED]


def _best(trials: Sequence[Trial]) -> Trial:
    return min(trials, key=lambda t: float(np.nan_to_num(t.ahead, nan=np.inf).mean()))


def _begin(stats: Statistics, table: ParameterTable, present: np.ndarray) -> np.ndarray:
    """Return the minimum of a quadratic approximation for a set of terms, ``(P,)``."""
    return table.at_scale(stats.x + stats.step(table, present, bounded=True))


class Trials:
    """Fits sets of terms to the problem of a fit.

    Args:
        estimate: A fit whose table has all terms.
        parts: Held out one at a time.
        settle_s: First part of a prediction, to which its initial state is fitted [s].
        free_run_s: Longest free run [s]; 0 skips the free runs.
        refits: Finished refits; None: estimates without a part are linear steps, which suffices to rank terms.
        on_set: Called with the names of each set before it is fitted.
    """

    def __init__(
        self,
        estimate: Fit,
        parts: Sequence[folds.Fold],
        settle_s: float,
        free_run_s: float,
        refits: Refits | None = None,
        on_set: Callable[[str], None] = lambda names: None,
    ) -> None:
        self._on_set = on_set
        self._estimate, self._parts, self._times = estimate, parts, (settle_s, free_run_s)
        self._refits = refits
        self._groups = folds.shared(parts)[0]
        self._problem = thinned(estimate.problem, folds.masks(estimate.problem, self._groups), MOST_OF_SETS)
        self._masks = folds.masks(self._problem, self._groups)
        self._least = estimate.loss if self._problem is estimate.problem else self._problem.loss(estimate.z)
        self._sigma = dict(zip(labels(self._problem), (s for _, s, _ in self._problem.fields), strict=True))

    @property
    def segments(self) -> int:
        """Number of segments that sets are fitted to: fewer than all where these would take long."""
        return len(self._problem.train)

    def singles(self, z: np.ndarray, present: np.ndarray) -> list[Trial]:
        """Return the fit of a set of terms, and those with the further terms that may help most, one each.

        Args:
            z: Shape ``(P,)``: an estimate with the set, where its fit begins.
            present: Shape ``(T,)``, bool: the terms of the set.
        """
        table = self._problem.table
        base, limits = self.attempt(present, [z], np.inf), table.of_limits()
        stats = self.wider(base)
        trials = [base]
        trials += [
            _with_gain(self.attempt(one, [_begin(stats, table, one), opened(table, base.z, one)], base.loss), base)
            for one in _proposed(stats, table, present, pairs=False)
        ]
        for i in np.flatnonzero(limits & ~present):
            one = present | (np.arange(len(present)) == i)
            trials.append(_with_gain(self.attempt(one, self.limited(base, one), base.loss), base))
        return trials

    def grown(self) -> list[Trial]:
        """Return the fits of ``grown``."""
        table = self._problem.table
        starts = [self._estimate.z, *table.starts()]
        return grown(self.attempt, self.wider, table, starts, self.limited, self.needed(), self._least, self.judge)

    def needed(self) -> list[int]:
        """Return the terms without which the fit of all terms predicts held-out parts worse, the most needed first."""
        table, every = self._problem.table, np.ones(len(self._problem.table.terms), bool)
        stats = statistics(self._problem, linearise(self._problem, self._estimate.z), self._masks)
        whole = on_held_out_parts(stats, table, every)
        lacks = [on_held_out_parts(stats, table, every & (np.arange(len(every)) != i)) for i in range(len(every))]
        order = np.argsort([-lack.mean() for lack in lacks])
        return [int(i) for i in order if better(whole, lacks[i])]

    def limited(self, trial: Trial, present: np.ndarray) -> list[np.ndarray]:
        """Return starts for a set with one more limit: the widest fit, the best level that acts, and a lower one."""
        problem, table = self._problem, self._problem.table
        new = table.of_terms(present) & ~table.of_terms(trial.present)
        x = np.repeat(table.scale(opened(table, trial.z, present))[0][None], _LEVELS + 1, axis=0)
        shares = np.linspace(1.0, INSIDE, _LEVELS + 1)[:, None]
        x[:, new] = (table.low + shares * table.span)[:, new]
        losses = problem.losses(table.at_scale(x), trial.z, problem.part(present=table.of_terms(present)))
        losses = np.nan_to_num(losses, nan=np.inf)
        acts = np.flatnonzero(np.abs(losses / losses[0] - 1.0) > _ACTS)
        if not len(acts):
            return [self._estimate.z]
        best = int(acts[np.argmin(losses[acts])])
        return [self._estimate.z, *(table.at_scale(x[i]) for i in (best, min(best + _LOWER, _LEVELS)))]

    def wider(self, trial: Trial) -> Statistics:
        """Return the loss of each group of parts around a trial, by the parameters of all terms."""
        return statistics(self._problem, linearise(self._problem, trial.z), self._masks)

    def attempt(self, present: np.ndarray, starts: Sequence[np.ndarray], most: float) -> Trial:
        """Return the fit of a set of terms ``(T,)``, from the best of some starts.

        Args:
            most: Loss of a smaller set; if the descent ends above it, it begins at the other starts, too.
        """
        problem, table = self._problem, self._problem.table
        data, names = problem.part(present=table.of_terms(present)), self._names(present)
        self._on_set(", ".join(names) or "no term")
        stored = self._refits.whole(names, problem, data) if self._refits else None
        z, loss = stored or self._descended(present, starts, most, data)
        self._least = min(self._least, loss)
        # Errors of linear steps suffice for a set that is clearly worse, or hardly better than a smaller one.
        near = loss <= min(_CLEAR * self._least, (1.0 - LITTLE) * most)
        return self._trial(present, z, loss, bool(self._refits) and near)

    def judge(self, trial: Trial) -> Trial:
        """Return a trial whose fit ended, with its errors by refits without each part."""
        problem, data = self._problem, self._problem.part(present=self._problem.table.of_terms(trial.present))
        refits, names, z, loss = self._refits, self._names(trial.present), trial.z, trial.loss
        if trial.judged or refits is None:
            return trial
        if not refits.whole(names, problem, data):  # to the end, as each refit would have to descend that far, too
            further = refine(problem, z[None], data, settle=False, gain=_GAIN)
            z, loss = further.z, further.loss
            self._least = min(self._least, loss)
        return self._trial(trial.present, z, loss, False, refits)

    def _trial(
        self, present: np.ndarray, z: np.ndarray, loss: float, unjudged: bool, refits: Refits | None = None
    ) -> Trial:
        """Return the trial of a fit, with errors by refits, or by linear steps."""
        problem, columns = self._problem, self._problem.table.of_terms(present)
        data, names = problem.part(present=columns), self._names(present)
        at = linearise(problem, z, data)
        stats = statistics(problem, at, self._masks)
        ends = self._without_each(z, at, stats, present)
        if refits:
            refits.begin(names, z, loss)
            rest = [problem.part(problem.train[touched], columns) for touched in self._masks]
            ends = [
                folds.refitted(refits, names, group, problem, end, one, gain=_GAIN)
                for group, end, one in zip(self._groups, ends, rest, strict=True)
            ]
        rows = folds.predicted(self._estimate, self._parts, stats, present, list(ends), *self._times)
        ahead, free = (np.array([self._mean_square(errors) for errors in kind]) for kind in (
            [row.ahead for row in rows], [row.free for row in rows]))  # fmt: skip
        return Trial(present, z, loss, stats, tuple(rows), ahead, free, above_noise(at), not unjudged)

    def _names(self, present: np.ndarray) -> tuple[str, ...]:
        return tuple(n for n, there in zip(self._problem.table.terms, present, strict=True) if there)

    def _descended(
        self, present: np.ndarray, starts: Sequence[np.ndarray], most: float, data: Data
    ) -> tuple[np.ndarray, float]:
        """Return the end of the descent from the best of some starts, and its loss; see ``attempt``."""
        problem, table = self._problem, self._problem.table
        starts = [opened(table, z, present) for z in starts]
        order = np.argsort(np.nan_to_num([problem.loss(z, data) for z in starts], nan=np.inf))
        ended = refine(problem, starts[order[0]][None], data, coarse=True)
        limit = bool(np.any(present & table.of_limits()))
        if len(order) > 1 and ended.loss > (1.0 - LITTLE if limit else 1.0 + _WORSE) * most:
            others = refine(problem, np.stack([starts[i] for i in order[1:3]]), data, coarse=True)
            ended = min(ended, others, key=lambda end: end.loss)
        return ended.z, ended.loss

    def _without_each(self, z: np.ndarray, at: Linearised, stats: Statistics, present: np.ndarray) -> np.ndarray:
        """Return the estimates without each group, ``(G, P)``: linear steps, shorter where a full one does not help."""
        problem, table, count = self._problem, self._problem.table, len(self._groups)
        steps = np.array([stats.step(table, present, np.arange(count) == g, bounded=True) for g in range(count)])
        points = at.x + np.concatenate([share * steps for share in _SHARES])
        # Simulate all candidates at a time, and compare each on the segments of the other groups.
        without = [c.parameter.without for c in table.columns]
        residuals = problem.with_values(z, np.where(table.of_terms(present), table.unscale(points), without))
        squares = np.nan_to_num(np.sum(residuals**2, axis=(2, 3)), nan=np.inf)
        ends = []
        for k, touched in enumerate(self._masks):
            candidates = range(k, len(points), count)
            ends.append(points[min(candidates, key=lambda g: float(squares[g][~touched].sum()))])
        return table.at_scale(np.array(ends))

    def _mean_square(self, errors: Mapping[str, float | None]) -> float:
        """Return the mean square of errors in deviations of the measurement; 0 if no joint moved."""
        squares = [(e / self._sigma[name]) ** 2 for name, e in errors.items() if e is not None]
        return float(np.mean(squares)) if squares else 0.0
