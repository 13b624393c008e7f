"""Holds parts of the recordings out of a fit, one at a time: estimates without a part, and their errors on that part.

Around an estimate, the loss of each part is approximated by a quadratic function of the parameters. So the estimate
without a part follows by linear algebra, and a short descent corrects it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.identification.fit import Fit, bounded_step, refine
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.predictions import labels
from sim2real.identification.residuals import Linearised, Problem
from sim2real.identification.segments import Span, on_grid

MOST = 12
"""Largest number of fits without a part."""
MOVES = 10.0
"""A joint moves if the range of its positions is above this [standard deviations of a measurement]."""
_ROUNDING_S = 1e-6
"""Largest rounding error of a time."""
_GAIN, _SLOPES = 1e-3, 1
"""Relative gain of the loss below which a descent without a part ends; and how many Jacobians one of its rounds
computes, as it begins with the Jacobian of all parts.
"""


@dataclass(frozen=True)
class HeldOutPart:
    """A fit without one part of the recordings, and its errors on that part.

    Attributes:
        values: Parameter -> estimate of this fit.
        share: Parameter -> share of the information in all recordings that the part holds.
        ahead: Field -> root mean square error on the part up to the longest horizon; None without data.
        free: Field -> root mean square error of a free run over the part; empty without a free run.
        run_s: Length of the free run [s].
    """

    name: str
    values: Mapping[str, Any]
    share: Mapping[str, float]
    ahead: Mapping[str, float | None]
    free: Mapping[str, float | None] = field(default_factory=dict)
    run_s: float = 0.0


@dataclass(frozen=True)
class Fold:
    """A held-out part of the recordings.

    Attributes:
        name: For tables.
        stretches: Recording, begin and end of each stretch [s].
    """

    name: str
    stretches: tuple[tuple[int, float, float], ...]

    def touches(self, spans: Sequence[Span], length_s: float) -> np.ndarray:
        """Return which segments share time with this part, ``(S,)``, bool."""
        recording, begins = np.array([s.recording for s in spans]), np.array([s.begin_s for s in spans])
        touched = np.zeros(len(spans), bool)
        for r, begin, end in self.stretches:
            within = (begins < end - _ROUNDING_S) & (begins + length_s > begin + _ROUNDING_S)
            touched |= (recording == r) & within
        return touched


def shared(parts: Sequence[Fold]) -> tuple[list[Fold], np.ndarray]:
    """Return at most ``MOST`` groups of parts, each held out of one fit, and the number of each part's group ``(K,)``.

    Of more parts, every twelfth joins the same group, so that neighbours, which are similar, stay in the fit.
    """
    of = np.arange(len(parts)) % MOST
    if len(parts) <= MOST:
        return list(parts), of
    members = [[p for p, group in zip(parts, of, strict=True) if group == g] for g in range(MOST)]
    groups = [Fold(f"group {g + 1}", tuple(s for p in some for s in p.stretches)) for g, some in enumerate(members)]
    return groups, of


def folds_of(problem: Problem, blocks: int, names: Sequence[str] = (), least: int = 2) -> list[Fold]:
    """Return the parts to hold out: each recording, or blocks of equal length if there are too few recordings.

    Args:
        blocks: Number of blocks that all recordings together are cut into.
        names: A name for each recording; recordings of one name are one part. Default: each is a part.

    Raises:
        UsageError: The recordings are too short to hold a part out.
    """
    spans = [problem.spans[i] for i in problem.train]
    recordings = sorted({s.recording for s in spans})
    name_of = {r: names[r] if names else f"recording {r + 1}" for r in recordings}
    groups = {name: [r for r in recordings if name_of[r] == name] for name in name_of.values()}
    # Hold out each recording, or blocks of equal length.
    if len(groups) >= max(least, 2):
        folds = [Fold(name, tuple((r, 0.0, np.inf) for r in members)) for name, members in groups.items()]
    else:
        folds = []
        for r in recordings:
            members = [s.begin_s for s in spans if s.recording == r]
            first, last = min(members), max(members) + problem.segment_s
            edges = np.linspace(first, last, -(-blocks // len(recordings)) + 1)
            edges[1:-1] = first + on_grid(edges[1:-1] - first)
            which = f"{name_of[r]}, " if len(recordings) > 1 else ""
            folds += [Fold(f"{which}{a:.0f} to {b:.0f} s", ((r, a, b),)) for a, b in pairwise(edges)]
    # Each part must hold segments, and leave segments to fit.
    counts = [int(f.touches(spans, problem.segment_s).sum()) for f in folds]
    if not 2 <= len(folds) <= len(spans) or min(counts) == 0 or max(counts) == len(spans):
        raise UsageError(
            f"{len(spans)} segments of {problem.segment_s:g} s cannot be divided into {len(folds)} parts to hold out",
            hint="set fewer --folds, shorter segments, or record for longer",
        )
    return folds


def masks(problem: Problem, parts: Sequence[Fold]) -> np.ndarray:
    """Return which fitted segments share time with each part, ``(K, S)``, bool."""
    spans = [problem.spans[i] for i in problem.train]
    return np.array([p.touches(spans, problem.segment_s) for p in parts])


@dataclass(frozen=True)
class Statistics:
    """The loss of K parts of the recordings around a point, as quadratic functions of the parameters' scales.

    Attributes:
        x: Shape ``(P,)``: the point.
        value: Shape ``(K,)``: sums of squares at the point.
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

    def step(self, table: ParameterTable, present: np.ndarray, held_out: np.ndarray | None = None) -> np.ndarray:
        """Return the step ``(P,)`` to the estimate of a smaller model, from all parts or all but the held-out ones.

        Args:
            present: Shape ``(T,)``, bool: the terms of the model.
            held_out: Shape ``(K,)``, bool: the held-out parts; None: all parts are used.
        """
        # Move the parameters of absent terms to their values without effect.
        gone = ~table.of_terms(present)
        moved = np.where(gone, table.without_terms(self.x, present) - self.x, 0.0)
        # Sum the quadratic functions of the parts.
        g, H = self.gradient.sum(axis=0), self.information.sum(axis=0) + self.prior
        if held_out is not None:
            g, H = g - self.gradient[held_out].sum(axis=0), H - self.information[held_out].sum(axis=0)
        return moved + bounded_step(H, g + H @ moved, self.x, table, ~gone)


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


def on_held_out_parts(stats: Statistics, table: ParameterTable, present: np.ndarray) -> np.ndarray:
    """Return the mean square on each part, ``(K,)``, with that part held out of the fit of a model with some terms."""
    scores = []
    parts = np.arange(len(stats.value))
    for k in parts:
        step = stats.step(table, present, parts == k)
        square = stats.value[k] + 2.0 * stats.gradient[k] @ step + step @ stats.information[k] @ step
        scores.append(square / stats.count[k])
    return np.array(scores)


def leave_out(estimate: Fit, parts: Sequence[Fold], settle_s: float, free_run_s: float = 0.0) -> list[HeldOutPart]:
    """Identify without each part, and predict that part.

    Args:
        parts: Held out one at a time.
        settle_s: First part of a prediction, to which its initial state is fitted [s].
        free_run_s: Longest free run [s]; 0 skips the free runs.
    """
    problem, groups = estimate.problem, shared(parts)[0]
    touched, every = masks(problem, groups), np.ones(len(problem.table.terms), bool)
    stats = statistics(problem, problem.linearise(estimate.x), touched)
    return predicted(estimate, parts, stats, every, refitted(problem, stats, touched, every), settle_s, free_run_s)


def refitted(problem: Problem, stats: Statistics, touched: np.ndarray, present: np.ndarray) -> list[np.ndarray]:
    """Return the estimates without each part, ``(P,)``.

    Each descent begins at the linear prediction from the other parts, and not at the estimate of all parts, which knows
    the held-out part: a descent may end where it begins.

    Args:
        stats: Statistics of the parts.
        touched: Shape ``(K, S)``, bool: the segments of each part.
        present: Shape ``(T,)``, bool: the terms of the model.
    """
    table, ends = problem.table, list[np.ndarray]()
    for k, segments in enumerate(touched):
        start = stats.x + stats.step(table, present, np.arange(len(touched)) == k)
        rest = problem.part(problem.train[segments], table.of_terms(present))
        ends.append(refine(problem, start[None], rest, gain=_GAIN, slopes=_SLOPES).x)
    return ends


def predicted(
    estimate: Fit,
    parts: Sequence[Fold],
    stats: Statistics,
    present: np.ndarray,
    ends: Sequence[np.ndarray],
    settle_s: float,
    free_run_s: float,
) -> list[HeldOutPart]:
    """Return the errors on each part by the estimate without the part's group.

    Args:
        stats: Statistics of the groups of ``shared``.
        present: Shape ``(T,)``, bool: the terms of the model.
        ends: Shape ``(G, P)``: the estimates without each group.
    """
    problem, table, of = estimate.problem, estimate.problem.table, shared(parts)[1]
    by_group = [table.decode(x, table.of_terms(present)) for x in ends]
    values = [by_group[g] for g in of]
    stacked = {n: np.stack([v[n] for v in values]) for n in values[0]}
    # The parts of a group share its information equally.
    own = np.einsum("kpp->kp", stats.information) / np.bincount(of)[:, None]
    total = np.maximum(own[of].sum(axis=0), 1e-300)
    shares = [dict(zip(table.names, row.tolist(), strict=True)) for row in own[of] / total]
    ahead = _ahead(estimate.windows, parts, stacked, settle_s)
    free, run_s = [{} for _ in parts], 0.0
    if free_run_s:
        free, run_s = _free(problem, parts, stacked, settle_s, free_run_s)
    rows = zip(parts, values, shares, ahead, free, strict=True)
    return [HeldOutPart(part.name, v, share, a, f, run_s) for part, v, share, a, f in rows]


def _ahead(
    windows: Problem, parts: Sequence[Fold], stacked: Mapping[str, Any], settle_s: float
) -> list[dict[str, float | None]]:
    """Return the errors of the windows of each part, predicted from the first ``settle_s`` of each window."""
    of, segment = np.nonzero(masks(windows, parts))
    return _errors(windows, stacked, of, windows.train[segment], settle_s, len(parts))


def _free(
    problem: Problem, parts: Sequence[Fold], stacked: Mapping[str, Any], settle_s: float, longest_s: float
) -> tuple[list[dict[str, float | None]], float]:
    """Return the errors of a free run of each part, and the length of the runs after ``settle_s`` [s]."""
    fitted = [problem.spans[i] for i in problem.train]
    where = []
    for k, part in enumerate(parts):
        for r, begin, end in part.stretches:
            begins = [s.begin_s for s in fitted if s.recording == r]
            first, last = max(begin, min(begins)), min(end, max(begins) + problem.segment_s)
            where.append((k, Span(r, first, False), last - first))
    # Each run ends with its part. All are simulated for the longest length, so that one program serves them.
    lengths_s = [min(longest_s, w[2]) for w in where]
    runs = problem.recut([w[1] for w in where], max(lengths_s), ends_s=lengths_s)
    of = np.array([w[0] for w in where])
    return _errors(runs, stacked, of, np.arange(len(where)), settle_s, len(parts)), max(lengths_s) - settle_s


def _errors(
    problem: Problem, stacked: Mapping[str, Any], of: np.ndarray, segment: np.ndarray, settle_s: float, parts: int
) -> list[dict[str, float | None]]:
    """Return the errors of each part, without the first ``settle_s`` of each segment.

    Args:
        of: Shape ``(S,)``: number of the part to which each segment belongs.
        segment: Shape ``(S,)``: numbers of the segments.
        parts: Number of parts.
    """
    errors = problem.predict({n: v[of] for n, v in stacked.items()}, segment, np.full(len(of), settle_s))
    beyond = [e[t > settle_s] for e, t in zip(errors, problem.ts[segment], strict=True)]
    sigmas = [sigma for _, sigma, _ in problem.fields]
    rows = []
    for k in range(parts):
        whole = np.sqrt(np.mean(np.concatenate([beyond[i] for i in np.flatnonzero(of == k)]) ** 2, axis=0)) * sigmas
        each = zip(labels(problem), whole.tolist(), moving(problem, segment[of == k]), strict=True)
        rows.append({label: error if moved else None for label, error, moved in each})
    return rows


def moving(problem: Problem, segments: np.ndarray) -> list[bool]:
    """Return for each column of the residuals whether its joint moves in one of the segments.

    Args:
        segments: Shape ``(S,)``: numbers of the segments.
    """
    measured, column, moves = problem.ts[segments] >= 0.0, 0, list[bool]()
    for channel in problem.channels:
        positions = problem.measured(column)[segments]  # the position comes first
        spread = np.max(positions, axis=1, where=measured, initial=-np.inf) - np.min(
            positions, axis=1, where=measured, initial=np.inf
        )
        moves += [bool(spread.max() > MOVES * channel.position_sigma)] * len(channel.fields)
        column += len(channel.fields)
    return moves
