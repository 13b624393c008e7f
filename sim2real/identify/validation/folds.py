"""Leaving parts of the recordings out, one at a time: what an identification is worth on data that it never saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.identification import HeldOutPart
from sim2real.errors import UsageError
from sim2real.identify.fit import Fit
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.uncertainty import linearise
from sim2real.identify.validation import optional_terms
from sim2real.identify.validation.prediction import labels

MOVES = 10.0
"""A joint moves where its positions spread over so many deviations of a measurement."""


_INSIDE = 0.01
"""How far inside of its bounds a parameter begins to be fitted [widths of the bounds]."""


@dataclass(frozen=True)
class Fold:
    """A part of the recordings that is left out.

    Attributes:
        name: What people call it.
        parts: The stretches that are left out: recording, begin and end [s].
    """

    name: str
    parts: tuple[tuple[int, float, float], ...]

    def touches(self, spans: Sequence[Span], length_s: float) -> np.ndarray:
        """Return which segments of a length share time with this part, ``(S,)``, bool."""
        return np.array(
            [
                any(
                    r == s.recording and s.begin_s < end and begin < s.begin_s + length_s
                    for r, begin, end in self.parts
                )
                for s in spans
            ]
        )


def folds_of(problem: Problem, blocks: int, names: Sequence[str] = (), least: int = 2) -> list[Fold]:
    """Return what to leave out: each recording once, or blocks of equal length where there are too few recordings.

    Args:
        blocks: How many blocks, of all recordings together.
        names: What recordings of one name are left out together are called; default: each goes by itself.

    Raises:
        UsageError: When there is too little to leave a part out.
    """
    spans = [problem.spans[i] for i in problem.train]
    recordings = sorted({s.recording for s in spans})
    called = {r: names[r] if names else f"recording {r + 1}" for r in recordings}
    groups = {name: [r for r in recordings if called[r] == name] for name in called.values()}
    if len(groups) >= max(least, 2):
        found = [Fold(name, tuple((r, 0.0, np.inf) for r in own)) for name, own in groups.items()]
    else:
        found = []
        for r in recordings:
            own = [s.begin_s for s in spans if s.recording == r]
            edges = np.linspace(min(own), max(own) + problem.segment_s, -(-blocks // len(recordings)) + 1)
            which = f"{called[r]}, " if len(recordings) > 1 else ""
            found += [Fold(f"{which}{a:.0f} to {b:.0f} s", ((r, a, b),)) for a, b in pairwise(edges)]
    counts = [int(f.touches(spans, problem.segment_s).sum()) for f in found]
    if not 2 <= len(found) <= len(spans) or min(counts) == 0 or max(counts) == len(spans):
        raise UsageError(
            f"{len(spans)} segments of {problem.segment_s:g} s cannot be divided into {len(found)} parts to leave out",
            hint="fewer --folds, a longer recording, or shorter segments",
        )
    return found


def masks(problem: Problem, parts: Sequence[Fold]) -> np.ndarray:
    """Return which fitted segments share time with each part, ``(K, S)``, bool."""
    spans = [problem.spans[i] for i in problem.train]
    return np.array([p.touches(spans, problem.segment_s) for p in parts])


def leave_out(
    found: Fit,
    parts: Sequence[Fold],
    settle_s: float,
    choose: bool,
    free_run_s: float = 0.0,
    among: np.ndarray | None = None,
) -> list[HeldOutPart]:
    """Identify without each part, from the estimate of all, and predict it.

    Args:
        parts: What is left out, one at a time.
        settle_s: First part of what is predicted, to which its initial state is fitted [s].
        choose: Whether the data that is left chooses the optional terms of the model; else all are kept.
        free_run_s: Longest stretch that is simulated in one go [s]; 0 leaves it out.
        among: Shape ``(T,)``, bool: the terms to choose from; default: all.
    """
    table, stats = found.problem.table, _statistics(found, parts)
    every = np.ones(len(table.terms), bool)
    kept = [optional_terms.choose(stats.without(k), table, among).kept if choose else every for k in range(len(parts))]
    ends = [_refit(found, parts, stats, k, own, choose) for k, own in enumerate(kept)]
    return _predicted(found, parts, stats, kept, ends, settle_s, free_run_s)


def compare_sets(
    found: Fit, parts: Sequence[Fold], sets: Sequence[np.ndarray], settle_s: float, free_run_s: float
) -> list[list[HeldOutPart]]:
    """Identify without each part with some sets of terms, and predict it: for each set what ``leave_out`` returns.

    The descent of a set begins at the end of the set before, too: with more terms no fit is worse, once it converged.

    Args:
        found: The estimate of all, with all terms.
        parts: What is left out, one at a time.
        sets: Shape ``(T,)`` each, bool: which terms are kept; each holds the one before.
        settle_s: First part of what is predicted, to which its initial state is fitted [s].
        free_run_s: Longest stretch that is simulated in one go [s].
    """
    stats, rows = _statistics(found, parts), []
    ends: list[np.ndarray] = []
    for own in sets:
        before = ends or [None] * len(parts)
        ends = [_descend(found, parts, stats, k, own, z, coarse=True) for k, z in enumerate(before)]
        rows.append(_predicted(found, parts, stats, [own] * len(parts), ends, settle_s, free_run_s))
    return rows


def _statistics(found: Fit, parts: Sequence[Fold]) -> optional_terms.Statistics:
    return optional_terms.statistics(found.problem, linearise(found.problem, found.z), masks(found.problem, parts))


def _refit(
    found: Fit, parts: Sequence[Fold], stats: optional_terms.Statistics, k: int, kept: np.ndarray, narrow: bool
) -> np.ndarray:
    """Return the estimate with some terms without a part ``(P,)``; ``narrow``: by way of that without terms, too."""
    none = np.zeros(len(kept), bool)
    first = _descend(found, parts, stats, k, none, coarse=True) if narrow and kept.any() else None
    return _descend(found, parts, stats, k, kept, first)


def _descend(
    found: Fit,
    parts: Sequence[Fold],
    stats: optional_terms.Statistics,
    k: int,
    kept: np.ndarray,
    smaller: np.ndarray | None = None,
    coarse: bool = False,
) -> np.ndarray:
    """Return the estimate with some terms without a part ``(P,)``.

    Never from the estimate of all: a refinement that finds nothing better would return what saw this part.

    Args:
        kept: Shape ``(T,)``, bool: which terms are part of the model.
        smaller: Shape ``(P,)``: the estimate with fewer terms without the same part, from which to begin as well.
        coarse: Whether the descent ends where it gains little: sets are compared by percents.
    """
    problem, table = found.problem, found.problem.table
    starts = [table.at_scale(stats.x + stats.step(table, kept, k, bounded=True))]
    if smaller is not None:
        place = {name: i for i, name in enumerate(table.terms)}
        x = table.scale(smaller)[0]
        for i, column in enumerate(table.columns):
            p = column.parameter
            if p.term:  # where it is absent; a little inside of a bound, at which the slope is 0
                off, inside = p.to_scale(min(max(p.without, p.low), p.high)), _INSIDE * table.span[i]
                added = kept[place[p.term]] and abs(x[i] - off) < inside
                x[i] = np.clip(off, table.low[i] + inside, table.high[i] - inside) if added else x[i]
        starts.append(table.at_scale(x))
    own = masks(problem, [parts[k]])[0]
    rest = problem.part(problem.train[own], table.of_terms(kept))
    return refine(problem, np.stack(starts), rest, coarse=coarse, settle=False).z


def _predicted(
    found: Fit,
    parts: Sequence[Fold],
    stats: optional_terms.Statistics,
    kept: Sequence[np.ndarray],
    ends: Sequence[np.ndarray],
    settle_s: float,
    free_run_s: float,
) -> list[HeldOutPart]:
    """Return how far estimates without each part, ``(P,)`` each, are off on that part."""
    problem, table = found.problem, found.problem.table
    values = [
        {
            n: np.asarray(v, np.float64)
            for n, v in table.decode(jnp.asarray(z, jnp.float32), table.of_terms(own)).items()
        }
        for z, own in zip(ends, kept, strict=True)
    ]
    names = [tuple(n for n, there in zip(table.terms, own, strict=True) if there) for own in kept]
    stacked = {n: np.stack([v[n] for v in values]) for n in values[0]}
    own = np.einsum("kpp->kp", stats.information)
    shares = [dict(zip(table.names, row.tolist(), strict=True)) for row in own / np.maximum(own.sum(axis=0), 1e-300)]
    ahead = _ahead(found.windows, parts, stacked, settle_s)
    free = _free(problem, parts, stacked, settle_s, free_run_s) if free_run_s else [{} for _ in parts]
    rows = zip(parts, names, values, shares, ahead, free, strict=True)
    return [HeldOutPart(part.name, *row) for part, *row in rows]


def _ahead(
    windows: Problem, parts: Sequence[Fold], stacked: Mapping[str, Any], settle_s: float
) -> list[dict[str, float | None]]:
    """Return the errors of the windows of each part, predicted from the first part of each."""
    fold, segment = np.nonzero(masks(windows, parts))
    return _errors(windows, stacked, fold, windows.train[segment], settle_s, len(parts))


def _free(
    problem: Problem, parts: Sequence[Fold], stacked: Mapping[str, Any], settle_s: float, longest_s: float
) -> list[dict[str, float | None]]:
    """Return the errors of each part, simulated in one go."""
    fitted = [problem.spans[i] for i in problem.train]
    where = []
    for k, part in enumerate(parts):
        for r, begin, end in part.parts:
            own = [s.begin_s for s in fitted if s.recording == r]
            first, last = max(begin, min(own)), min(end, max(own) + problem.segment_s)
            where.append((k, Span(r, first, False), last - first))
    length_s = min(longest_s, *(w[2] for w in where))
    runs = problem.recut([w[1] for w in where], length_s)
    fold = np.array([w[0] for w in where])
    return _errors(runs, stacked, fold, np.arange(len(where)), settle_s, len(parts))


def _errors(
    problem: Problem, stacked: Mapping[str, Any], fold: np.ndarray, segment: np.ndarray, settle_s: float, parts: int
) -> list[dict[str, float | None]]:
    """Return the errors of each part's segments beyond the first part of each."""
    errors = problem.predict({n: v[fold] for n, v in stacked.items()}, segment, np.full(len(fold), settle_s))
    beyond = [e[t > settle_s] for e, t in zip(errors, problem.ts[segment], strict=True)]
    sigmas = [sigma for _, sigma, _ in problem.fields]
    found = []
    for k in range(parts):
        whole = np.sqrt(np.mean(np.concatenate([beyond[i] for i in np.flatnonzero(fold == k)]) ** 2, axis=0)) * sigmas
        each = zip(labels(problem), whole.tolist(), moving(problem, segment[fold == k]), strict=True)
        found.append({label: error if moved else None for label, error, moved in each})
    return found


def moving(problem: Problem, segments: np.ndarray) -> list[bool]:
    """Return of each column of the residuals whether its joint moves in one of some segments.

    Args:
        segments: Shape ``(S,)``: numbers of segments.
    """
    there, column, found = problem.ts[segments] >= 0.0, 0, list[bool]()
    for channel in problem.channels:
        read = problem.measured(column)[segments]  # the position comes first
        spread = np.max(read, axis=1, where=there, initial=-np.inf) - np.min(read, axis=1, where=there, initial=np.inf)
        found += [bool(spread.max() > MOVES * channel.position_sigma)] * len(channel.fields)
        column += len(channel.fields)
    return found
