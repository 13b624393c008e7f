"""Optional terms of a model, chosen by forward selection on held-out parts.

Linear algebra around the present model proposes candidates: sets with one or two further terms and smaller errors on
held-out parts. Each round fits the candidates and keeps the best, until no error falls by a tenth. The estimates
without a part are linear steps for all candidates, and refits for the best. One such round finds what a model lacks.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sim2real.artifacts.identification import Term
from sim2real.identification import held_out
from sim2real.identification.fit import ROUGH, Fit, refine
from sim2real.identification.held_out import Fold, HeldOutPart, Statistics, on_held_out_parts, statistics
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.predictions import labels
from sim2real.identification.residuals import MOST_OF_SETS, Linearised, Part, thinned
from sim2real.identification.uncertainty import above_noise

ALIKE = 1.1
"""Two errors count as equal up to this ratio."""
_FAR = 1.5
"""A further term harms if the errors of free runs grow by more than this factor."""
_LITTLE = 0.01
"""A further term gains too little if it lowers the loss by less than this share."""
_PROMISING = 0.95
"""A further term is fitted only if linear algebra predicts an error below this share of the present one."""
MENDS = 0.5
"""A model lacks a term that lowers the errors on held-out parts to less than this share."""
_LEVELS, _LOWER = 16, 2
"""Number of levels of a limit that are simulated; how many levels below the best the second start is."""
_DIVERGED = 1e9
"""Residual that a diverging simulation counts as [standard deviations of a measurement]."""
_LIMITED = 2.0
"""Limits are tried if the residuals are above this many times the noise: a limit that acts leaves far more."""
_TRIED = 3
"""Most candidates that are fitted in a round, not counting limits."""
_SHARES = (1.0, 0.25, 0.06)
"""Shares of the linear step to the estimate without a part; the best of them is taken."""
_INSIDE = 0.01
"""Lowest simulated level of a limit, as a share of the range between its bounds."""


@dataclass(frozen=True)
class Trial:
    """The fit of one set of optional terms.

    Attributes:
        present: Shape ``(T,)``, bool: the terms.
        x: Shape ``(P,)``: the estimate; parameters of absent terms have their values without the term.
        loss: Loss of the estimate.
        rows: The estimates without each part, and their errors on it.
        ahead: Shape ``(K,)``: mean square of the errors up to the horizon on each part, with that part held out.
        free: Shape ``(K,)``: mean square of the errors in free runs; zeros without free runs.
        above: Ratio of the residuals to the noise of the sensor.
    """

    present: np.ndarray
    x: np.ndarray
    loss: float
    rows: Sequence[HeldOutPart]
    ahead: np.ndarray
    free: np.ndarray
    above: float = np.inf

    def names(self, table: ParameterTable) -> tuple[str, ...]:
        """Return the names of the terms."""
        return tuple(n for n, present in zip(table.terms, self.present, strict=True) if present)

    @property
    def error(self) -> float:
        """Root mean square of the errors on held-out parts [standard deviations of a measurement]."""
        return float(np.sqrt(np.nan_to_num(self.ahead, nan=np.inf).mean()))

    @property
    def free_error(self) -> float:
        """Root mean square of the errors in free runs [standard deviations of a measurement]."""
        return float(np.sqrt(np.nan_to_num(self.free, nan=np.inf).mean()))

    def is_better_than(self, other: "Trial") -> bool:
        """Return whether the errors on held-out parts are clearly smaller, and errors in free runs not far larger."""
        return self.error * ALIKE < other.error and not self.free_error > _FAR * other.free_error

    def mends(self, other: "Trial") -> bool:
        """Return whether the errors on held-out parts or in free runs are below half of another set's errors."""
        halves = self.error < MENDS * other.error or self.free_error < MENDS * other.free_error
        return halves and self.error < other.error and not self.free_error > _FAR * other.free_error


@dataclass(frozen=True)
class Selection:
    """A selection of terms: the chosen set, and all sets that were fitted."""

    chosen: Trial
    trials: tuple[Trial, ...]


class TermSearch:
    """Fits sets of terms to the problem of a fit.

    Args:
        estimate: A fit whose table has all terms.
        parts: Held out one at a time.
        settle_s: First part of a prediction, to which its initial state is fitted [s].
        free_run_s: Longest free run [s]; 0 skips the free runs.
        on_set: Called with the names of each set before it is fitted.
    """

    def __init__(
        self,
        estimate: Fit,
        parts: Sequence[Fold],
        settle_s: float,
        free_run_s: float,
        on_set: Callable[[str], None] = lambda names: None,
    ) -> None:
        self._estimate, self._parts, self._times = estimate, parts, (settle_s, free_run_s)
        self._on_set = on_set
        self._groups = held_out.shared(parts)[0]
        self._problem = thinned(estimate.problem, held_out.masks(estimate.problem, self._groups), MOST_OF_SETS)
        self._masks = held_out.masks(self._problem, self._groups)
        self._sigma = dict(zip(labels(self._problem), (s for _, s, _ in self._problem.fields), strict=True))

    @property
    def segments(self) -> int:
        """Number of segments to which sets of terms are fitted: not all, if that would take long."""
        return len(self._problem.train)

    def select(self) -> Selection:
        """Return the terms that improve the prediction of held-out parts."""
        table = self._problem.table
        none = np.zeros(len(table.terms), bool)
        chosen = self._judged(self._attempt(none, [self._estimate.x, *table.starts()], np.inf))
        trials = [chosen]
        while True:
            fitted = self._round(chosen)
            trials += fitted
            candidates = sorted((t for t in fitted if t.loss < (1.0 - _LITTLE) * chosen.loss), key=lambda t: t.error)
            # The linear steps rank the candidates; the best ones are judged by refits.
            helpful = next((j for t in candidates if t.is_better_than(chosen)
                            and (j := self._judged(t)).is_better_than(chosen)), None)  # fmt: skip
            if helpful is None:
                break
            trials[next(i for i, t in enumerate(trials) if t.present is helpful.present)] = helpful
            chosen = helpful
        return Selection(chosen, tuple(trials))

    def further(self, x: np.ndarray, present: np.ndarray) -> Selection:
        """Return the fits of a set of terms, and with one further term each; a set that halves the errors is chosen.

        Args:
            x: Shape ``(P,)``: the estimate with the set.
            present: Shape ``(T,)``, bool: the terms of the set.
        """
        base = self._trial(present, x, self._problem.loss(x, self._part(present)))
        trials = self._round(base, pairs=False)
        mending = [t for t in trials if t.mends(base)]
        return Selection(min(mending, key=lambda t: t.error, default=base), (base, *trials))

    def _part(self, present: np.ndarray) -> Part:
        return self._problem.part(present=self._problem.table.of_terms(present))

    def _round(self, base: Trial, pairs: bool = True) -> list[Trial]:
        """Return fits with the one or two further terms that may help most, and with each limit that may act."""
        table = self._problem.table
        at = self._problem.linearise(base.x)
        around = [statistics(self._problem, at, self._masks)]
        # A friction that is negligible now may be needed with another term; at 0 its derivative is 0, so start above.
        small = np.array([c.vanishes and c.transform == "log" for c in table.columns])
        small &= table.of_terms(base.present) & (base.x < table.start() - 1.0)
        if small.any():
            raised = np.where(small, table.start(), base.x)
            around.append(statistics(self._problem, self._problem.linearise(raised), self._masks))
        trials = []
        for present in _proposed(around, table, base.present, pairs):
            begins = [stats.x + stats.step(table, present) for stats in around]
            trials.append(self._attempt(present, [*begins, base.x], base.loss))
        limits = np.flatnonzero(table.of_limits() & ~base.present) if base.above > _LIMITED else []
        for i in limits:
            present = base.present | (np.arange(len(base.present)) == i)
            if starts := self._limited(base, at, present):
                trials.append(self._attempt(present, starts, base.loss, afresh=True))
        return trials

    def _limited(self, base: Trial, at: Linearised, present: np.ndarray) -> list[np.ndarray]:
        """Return starts of a fit with one more limit: the best level and a lower one; none if no level helps.

        At each level the residuals are simulated, and linear algebra moves the other parameters.

        Args:
            at: The present model, with the derivatives by its parameters.
        """
        problem, table = self._problem, self._problem.table
        new, own = table.of_terms(present) & ~table.of_terms(base.present), table.of_terms(base.present)
        shares = np.linspace(1.0, _INSIDE, _LEVELS + 1)[:, None]
        x = np.where(new, table.low + shares * table.span, base.x)
        limited = problem.robustly(x, base.x, self._part(present)).reshape(_LEVELS + 1, -1)
        limited = np.nan_to_num(limited, nan=_DIVERGED)
        basis = np.linalg.qr((at.jacobian * table.span).reshape(-1, len(table))[:, own])[0]
        errors = np.linalg.norm(limited - limited @ basis @ basis.T, axis=1)
        best = int(np.argmin(errors))
        if not errors[best] < _PROMISING * errors[0]:
            return []
        return [x[i] for i in (best, min(best + _LOWER, _LEVELS))]

    def _attempt(self, present: np.ndarray, starts: Sequence[np.ndarray], most: float, afresh: bool = False) -> Trial:
        """Return the fit of a set of terms ``(T,)`` from the best of some starts, with errors by linear steps.

        Args:
            most: Loss of a smaller set; if the descent ends above it, the other starts are tried, too.
            afresh: Whether to begin at the nominal values, too: while a limit was missing, other estimates were wrong.
        """
        problem, table = self._problem, self._problem.table
        part, names = problem.part(present=table.of_terms(present)), self._names(present)
        self._on_set(", ".join(names) or "no term")
        starts = [table.without_terms(x, present) for x in starts]
        order = np.argsort(np.nan_to_num([problem.loss(x, part) for x in starts], nan=np.inf))
        begins = [starts[order[0]], *([table.without_terms(table.start(), present)] if afresh else [])]
        ended = refine(problem, np.stack(begins), part, gain=ROUGH)
        if len(order) > 1 and ended.loss > (1.0 - _LITTLE) * most:
            others = refine(problem, np.stack([starts[i] for i in order[1:3]]), part, gain=ROUGH)
            ended = min(ended, others, key=lambda end: end.loss)
        return self._trial(present, ended.x, ended.loss)

    def _judged(self, trial: Trial) -> Trial:
        """Return a trial whose fit ended, with its errors by refits without each part."""
        # Descend to the minimum first, as otherwise each refit would have to.
        further = refine(self._problem, trial.x[None], self._part(trial.present), gain=self._problem.precision)
        return replace(self._trial(trial.present, further.x, further.loss, refit=True), present=trial.present)

    def _trial(self, present: np.ndarray, x: np.ndarray, loss: float, refit: bool = False) -> Trial:
        """Return the trial of a fit, with errors by refits, or by linear steps."""
        problem, columns = self._problem, self._problem.table.of_terms(present)
        at = problem.linearise(x, problem.part(present=columns))
        stats = statistics(problem, at, self._masks)
        ends = held_out.refitted(problem, stats, self._masks, present) if refit else None
        ends = list(self._without_each(x, stats, present)) if ends is None else ends
        rows = held_out.predicted(self._estimate, self._parts, stats, present, ends, *self._times)
        ahead, free = (np.array([self._mean_square(errors) for errors in kind]) for kind in (
            [row.ahead for row in rows], [row.free for row in rows]))  # fmt: skip
        return Trial(present, x, loss, tuple(rows), ahead, free, above_noise(at))

    def _without_each(self, x: np.ndarray, stats: Statistics, present: np.ndarray) -> np.ndarray:
        """Return the estimates without each group, ``(G, P)``: linear steps, shortened if a full step does not help."""
        problem, table, count = self._problem, self._problem.table, len(self._groups)
        steps = np.array([stats.step(table, present, np.arange(count) == g) for g in range(count)])
        points = table.within(x + np.concatenate([share * steps for share in _SHARES]))
        # Simulate all candidates at once, and compare each on the segments of the other groups.
        residuals = problem.robustly(points, x, self._part(present))
        squares = np.nan_to_num(np.sum(residuals**2, axis=(2, 3)), nan=np.inf)
        best = [
            min(range(k, len(points), count), key=lambda g, t=touched: float(squares[g][~t].sum()))
            for k, touched in enumerate(self._masks)
        ]
        return points[best]

    def _names(self, present: np.ndarray) -> tuple[str, ...]:
        return tuple(n for n, there in zip(self._problem.table.terms, present, strict=True) if there)

    def _mean_square(self, errors: Mapping[str, float | None]) -> float:
        """Return the mean square of the joints' errors [variances of the measurement]; 0 if no joint moved."""
        squares = [(e / self._sigma[name]) ** 2 for name, e in errors.items() if e is not None]
        return float(np.mean(squares)) if squares else 0.0


def _proposed(
    around: Sequence[Statistics], table: ParameterTable, present: np.ndarray, pairs: bool
) -> list[np.ndarray]:
    """Return larger sets of terms, ``(T,)`` each, with the smallest predicted errors first.

    The first has one further term. The others have two, if that is clearly better, or another one. Sets whose predicted
    gain is below 5 % are left out.

    Args:
        around: The loss around one or several points: of these, the one from which a set gains most counts.
    """
    absent, place = np.flatnonzero(~present & ~table.of_limits()), np.arange(len(present))

    def error(one: np.ndarray, stats: Statistics) -> float:
        return float(np.sqrt(np.maximum(on_held_out_parts(stats, table, one).mean(), 1e-300)))

    def ordered(count: int) -> list[tuple[float, np.ndarray]]:
        sets = [present | np.isin(place, more) for more in combinations(absent, count)]
        shares = [min(error(one, s) / before for s, before in zip(around, now, strict=True)) for one in sets]
        rated = sorted(zip(shares, sets, strict=True), key=lambda pair: pair[0])
        return [pair for pair in rated if pair[0] < _PROMISING]

    now = [error(present, stats) for stats in around]
    ones = ordered(1)
    best = ones[0][0] if ones else 1.0
    twos = [pair for pair in (ordered(2)[:1] if pairs else []) if pair[0] * ALIKE < best]
    return [one for _, one in [*ones[:1], *twos, *ones[1:]]][:_TRIED]


def gains(selection: Selection, table: ParameterTable) -> tuple[Term, ...]:
    """Return all terms with their gains; those in use come first, then the others by their gain.

    A gain is the relative difference of the errors of two sets that differ by this term. For a term in use, the pair
    that is closest to the chosen set counts. For another term, only the chosen set with and without it: with a smaller
    set, the gain may belong to a term that was chosen later. A term that makes free runs far worse harms, whatever its
    gain.
    """
    rows, chosen = [], selection.chosen
    for i, name in enumerate(table.terms):
        one, used = np.arange(len(table.terms)) == i, bool(chosen.present[i])
        pairs = [
            (with_it, without)
            for with_it in selection.trials
            for without in selection.trials
            if not without.present[i] and np.array_equal(with_it.present, without.present | one)
            if used or np.array_equal(without.present, chosen.present)
        ]
        if not pairs:
            rows.append(Term(name, used))
            continue
        off = [int(np.sum((with_it.present ^ chosen.present) & ~one)) for with_it, _ in pairs]
        with_it, without = pairs[int(np.argmin(off))]
        before, after = without.error, with_it.error
        if with_it.free_error > _FAR * without.free_error:
            before, after = without.free_error, with_it.free_error
        rows.append(Term(name, used, 1.0 - after / before if before > 0.0 else None))
    return tuple(sorted(rows, key=lambda row: (not row.used, -(row.gain or 0.0))))
