"""Leaving parts of the recordings out, one at a time: what an identification is worth on data that it never saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify import terms
from sim2real.identify.fit import Fit
from sim2real.identify.prediction import labels
from sim2real.identify.problem import Problem
from sim2real.identify.refine import refine
from sim2real.identify.segments import Span
from sim2real.identify.uncertainty import linearise

MOVES = 10.0
"""A joint moves where its positions spread over so many deviations of a measurement."""


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


@dataclass(frozen=True)
class LeftOut:
    """What was identified without one part, and how far it is off there.

    Attributes:
        fold: The part.
        values: The estimate without it, by name.
        kept: Names of the optional terms that the rest of the data chose.
        share: Label of a free parameter -> share of what all recordings say about it that this part says, in [0, 1].
        ahead: Field -> root mean square error up to the horizon of the windows; None where its joint did not move:
            to say that what rests will rest is easy, and tells nothing of parts in which it moves.
        free: The same when the part is simulated in one go, from its first samples.
    """

    fold: Fold
    values: Mapping[str, Any]
    kept: tuple[str, ...]
    share: Mapping[str, float]
    ahead: Mapping[str, float | None]
    free: Mapping[str, float | None]


def folds_of(problem: Problem, blocks: int, names: Sequence[str] = (), least: int = 2) -> list[Fold]:
    """Return what to leave out: each recording once, or blocks of equal length where there are too few recordings.

    Args:
        problem: Its fitted segments are divided.
        blocks: How many blocks, of all recordings together.
        names: What recordings of one name are left out together are called; default: each goes by itself.
        least: With fewer recordings each is divided into blocks.

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
    found: Fit, parts: Sequence[Fold], settle_s: float, choose: bool, free_run_s: float = 0.0
) -> list[LeftOut]:
    """Identify without each part, from the estimate of all, and predict it.

    Args:
        found: The estimate of all.
        parts: What is left out, one at a time.
        settle_s: First part of what is predicted, to which its initial state is fitted [s].
        choose: Whether the data that is left chooses the optional terms of the model; else all are kept.
        free_run_s: Longest stretch that is simulated in one go [s]; 0 leaves it out.
    """
    problem, table = found.problem, found.problem.table
    touched = masks(problem, parts)
    stats = terms.statistics(problem, linearise(problem, found.z), touched)
    values, kept = [], []
    for k, mask in enumerate(touched):
        chosen = terms.choose(stats.without(k), table).kept if choose else np.ones(len(table.terms), bool)
        own = table.of_terms(chosen)
        # Never from the estimate of all: a refinement that finds nothing better would return what saw this part.
        start = table.at_scale(stats.x + stats.step(table, chosen, k, bounded=True))
        rest = problem.part(problem.train[mask], own)
        z = refine(problem, start[None], rest, settle=False).z
        values.append({n: np.asarray(v, np.float64) for n, v in table.decode(jnp.asarray(z, jnp.float32), own).items()})
        kept.append(tuple(n for n, there in zip(table.terms, chosen, strict=True) if there))
    stacked = {n: np.stack([v[n] for v in values]) for n in values[0]}
    own = np.einsum("kpp->kp", stats.information)
    shares = [dict(zip(table.names, row.tolist(), strict=True)) for row in own / np.maximum(own.sum(axis=0), 1e-300)]
    ahead = _ahead(found.windows, parts, stacked, settle_s)
    free = _free(problem, parts, stacked, settle_s, free_run_s) if free_run_s else [{} for _ in parts]
    return [LeftOut(*row) for row in zip(parts, values, kept, shares, ahead, free, strict=True)]


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
        problem: The recordings.
        segments: Shape ``(S,)``: numbers of segments.
    """
    there, column, found = problem.ts[segments] >= 0.0, 0, list[bool]()
    for channel in problem.channels:
        read = problem.measured(column)[segments]  # the position comes first
        spread = np.max(read, axis=1, where=there, initial=-np.inf) - np.min(read, axis=1, where=there, initial=np.inf)
        found += [bool(spread.max() > MOVES * channel.position_sigma)] * len(channel.fields)
        column += len(channel.fields)
    return found
