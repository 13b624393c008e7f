"""Predictions of a model, their errors up to a horizon, and baselines such as standing still."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import ArrayLike

from sim2real.artifacts.identification import (
    GOAL,
    STANDING_STILL,
    WITHOUT_DELAYS,
    ComparedError,
    WorstSecond,
    worst_window,
)
from sim2real.errors import UsageError
from sim2real.graph.node import TICKS_PER_S
from sim2real.identification.model import IdentifiableModel, position_of
from sim2real.identification.residuals import Problem
from sim2real.log.schema import unit_of

_BETTER = 0.95
"""A model is better than a baseline if its error is below this share of the baseline's error."""
NOISE = 2.0
"""Errors below this many standard deviations of the measurement count as noise."""


@dataclass(frozen=True)
class Position:
    """A measured position that is judged.

    Attributes:
        column: Name of its column, such as ``position[1]``.
        name: Name that users see, such as ``elbow``.
        sigma: Standard deviation of a measurement.
    """

    column: str
    name: str
    unit: str
    sigma: float


def positions(model: IdentifiableModel, units: Mapping[str, str]) -> list[Position]:
    """Return the measured positions of a model, which are judged one by one.

    Args:
        units: Field -> unit.

    Raises:
        UsageError: Two channels have one name.
    """
    names = [c.name for c in model.channels]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise UsageError(f"two measured joints are called {twice[0]!r}", hint="give each channel another label")
    return [Position(position_of(c), c.name, unit_of(position_of(c), units), c.position_sigma) for c in model.channels]


def samples(
    problem: Problem, models: Mapping[str, Mapping[str, ArrayLike]], settle_s: float, held_out: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Simulate all segments with each model; initial states of held-out segments are fitted to their first part.

    Args:
        settle_s: Length of that first part [s].
        held_out: Shape ``(S,)``, bool: the held-out segments; default: those that are not fitted.

    Returns:
        Columns ``(N,)``: ``t`` and ``into`` [s], ``segment``, ``recording``, ``held_out``; for each field of a channel
        the measurement ``FIELD_measured`` and each prediction ``FIELD_MODEL``. If commands are positions, the joint's
        goal is the prediction of the baseline ``goal``.
    """
    held_out = ~np.isin(np.arange(problem.segments), problem.train) if held_out is None else held_out
    every, fit_s = np.arange(problem.segments), np.where(held_out, settle_s, problem.segment_s)
    columns: dict[str, np.ndarray] = {}
    # Simulate the segments with each model.
    for name, values in models.items():
        rows = {n: np.broadcast_to(v, (problem.segments, *np.shape(v))) for n, v in values.items()}
        residuals, ts = problem.predict(rows, every, fit_s), problem.ts
        at = np.nonzero(ts >= 0)
        if not columns:
            segment, into = at[0], ts[at]
            columns = {
                "t": problem.begins_s[segment] + into,
                "segment": segment,
                "recording": problem.recording[segment],
                "held_out": held_out[segment],
                "into": into,
            }
            for i, label in enumerate(labels(problem)):
                columns[f"{label}_measured"] = problem.measured(i)[at]
            columns |= _goals(problem, segment, into)
        for i, (label, (_, sigma, _)) in enumerate(zip(labels(problem), problem.fields, strict=True)):
            columns[f"{label}_{name}"] = columns[f"{label}_measured"] + residuals[..., i][at] * sigma
    return columns


def _goals(problem: Problem, segment: np.ndarray, into: np.ndarray) -> dict[str, np.ndarray]:
    """Return the newest goal sent before each sample, a column for each channel with goals."""
    columns = {}
    for c in problem.channels:
        if c.goal is None:
            continue
        # Find the node that sends the goals of this channel.
        node, place = next(
            (n, fields.index(c.goal))
            for n, tree in problem.model.given.items()
            if c.goal in (fields := jax.tree_util.tree_leaves(tree))
        )
        rows = np.asarray(jax.tree_util.tree_leaves(problem.messages[node])[place])
        sent_s = problem.timeline.vertices[node].end / TICKS_PER_S
        # Take the newest goal before each sample.
        goals = np.empty(len(into))
        for s in np.unique(segment):
            mask = segment == s
            newest = np.searchsorted(sent_s[s], into[mask], side="right") - 1
            goals[mask] = c.of(rows[s])[np.maximum(newest, 0)]
        columns[f"{position_of(c)}_{GOAL}"] = goals
    return columns


def labels(problem: Problem) -> list[str]:
    """Return a name for each column of the residuals: the field, with the channel's index if it is a vector."""
    return [f if c.index is None else f"{f}[{c.index}]" for c in problem.channels for f, _ in c.fields]


def errors(
    columns: Mapping[str, np.ndarray],
    models: Sequence[str],
    positions: Sequence[Position],
    settle_s: float,
    horizon_s: float,
) -> list[ComparedError]:
    """Return the errors of each position up to a horizon on held-out segments, of a model and of baselines.

    The first model is judged; the others are baselines. A further baseline keeps the last measurement; if commands are
    positions, the goal itself is another baseline. A position without data has no row.

    Args:
        columns: Result of ``samples``.
        settle_s: First part of held-out segments, to which initial states were fitted; horizons begin at its end [s].
    """
    ahead = columns["into"] - settle_s
    pick = columns["held_out"].astype(bool) & (ahead > 0) & (ahead <= horizon_s)
    found: dict[Position, dict[str, float]] = {}
    for p in positions:
        measured = columns[f"{p.column}_measured"][pick]
        predicted = {m: _predicted(columns, p.column, m, ahead) for m in (*models, *_baselines(columns))}
        off = {m: values[pick] - measured for m, values in predicted.items() if values is not None}
        found[p] = {m: float(np.sqrt(np.mean(o**2))) for m, o in off.items() if o.size}
    return ranked({p: own for p, own in found.items() if own}, horizon_s)


def ranked(found: Mapping[Position, Mapping[str, float]], horizon_s: float) -> list[ComparedError]:
    """Return a row for each position, with the errors of all models; the first model is judged.

    First come positions for which a baseline is as good, then the others by the ratio of error to best baseline. Errors
    below the noise of the measurement count as the noise.
    """
    rows = []
    for p, errors_ in found.items():
        # A prediction that diverged to NaN has an infinite error.
        finite = {m: e if math.isfinite(e) else math.inf for m, e in errors_.items()}
        error, noise = finite.pop(next(iter(finite))), NOISE * p.sigma
        best = min(finite.values(), default=math.inf)
        excess = max(error, noise) / max(best, noise) if math.isfinite(best) else 0.0
        # The model without delays is no baseline here: if it is as good, the data needs no delays.
        others = {m: e for m, e in finite.items() if m != WITHOUT_DELAYS}
        as_good = () if error <= noise else tuple(m for m, e in others.items() if error > _BETTER * e)
        size, *sizes = (e if math.isfinite(e) else None for e in (error, *finite.values()))
        baselines = dict(zip(finite, sizes, strict=True))
        rows.append(
            (excess, ComparedError("", p.name, p.unit, horizon_s, size, False, None, baselines, as_good, p.column))
        )
    return [row for _, row in sorted(rows, key=lambda pair: (not pair[1].as_good, -pair[0]))]


def _baselines(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of the baselines without a model."""
    return [STANDING_STILL, *([GOAL] if any(n.endswith(f"_{GOAL}") for n in columns) else [])]


def _predicted(columns: Mapping[str, np.ndarray], field: str, model: str, ahead: np.ndarray) -> np.ndarray | None:
    """Return a model's prediction ``(N,)``; None if it does not predict the field.

    Standing still predicts the last measurement before the horizon.
    """
    if model != STANDING_STILL:
        return columns.get(f"{field}_{model}")
    predicted = np.zeros_like(ahead)
    for segment in np.unique(columns["segment"]):
        rows = np.flatnonzero(columns["segment"] == segment)
        past = rows[ahead[rows] <= 0]
        predicted[rows] = columns[f"{field}_measured"][past[-1] if past.size else rows[0]]
    return predicted


def replays(problem: Problem, values: Mapping[str, ArrayLike], settle_s: float, kind: str) -> dict[str, np.ndarray]:
    """Return columns of the R held-out segments, named ``KIND/...``; empty if several nodes drive the model.

    Args:
        values: Values of all parameters.
        settle_s: Length of the first part of a segment, to which its initial state is fitted [s].

    Returns:
        ``segment``, ``recording``, ``begin_s``: ``(R,)``. ``start (R, 2 * channels)``: positions, then velocities.
        ``sent_s (R, K)``: when each command was sent [s from the segment's start], NaN after the last one.
        ``command/FIELD (R, K, ...)``.
    """
    if len(problem.messages) != 1:
        return {}
    held_out = np.flatnonzero(~np.isin(np.arange(problem.segments), problem.train))
    rows = {n: np.broadcast_to(v, (len(held_out), *np.shape(v))) for n, v in values.items()}
    starts = problem.simulated(rows, held_out, np.full(len(held_out), settle_s))[1]
    ((node, messages),) = problem.messages.items()
    steps = problem.timeline.vertices[node]
    sent = np.where(np.arange(steps.end.shape[1]) < steps.count[:, None], steps.end / TICKS_PER_S, np.nan)
    columns = {
        "segment": held_out,
        "recording": problem.recording[held_out],
        "begin_s": problem.begins_s[held_out],
        "start": starts,
        "sent_s": sent[held_out],
    }
    names = jax.tree_util.tree_leaves(problem.model.given[node])
    for name, field in zip(names, jax.tree_util.tree_leaves(messages), strict=True):
        columns[f"command/{name}"] = np.asarray(field)[held_out]
    return {f"{kind}/{name}": column for name, column in columns.items()}


def worst_second(
    samples: Mapping[str, np.ndarray], positions: Sequence[Position], settle_s: float, logs: Sequence[str]
) -> tuple[WorstSecond, np.ndarray] | None:
    """Return the worst second of all joints, logs and segments, and a mask ``(N,)`` of its samples, or None.

    It has the largest error beyond the noise, as a share of the joint's motion, so that joints that move little and
    joints that move much compare. If all errors are noise, it has the largest error in standard deviations of a
    measurement.

    Args:
        samples: Result of ``samples``.
        settle_s: First part of held-out segments, to which initial states were fitted; it does not count [s].
        logs: Names of the logs.
    """
    best: tuple[tuple[float, float], WorstSecond, np.ndarray] | None = None
    segments = list(_segments(samples, settle_s)) if samples else []
    for p in positions:
        if f"{p.column}_identified" not in samples:
            continue
        measured = samples[f"{p.column}_measured"].astype(np.float64)
        squares = (measured - samples[f"{p.column}_identified"]) ** 2
        motion = {r: float(np.std(measured[samples["recording"] == r])) for r in np.unique(samples["recording"])}
        for rows in segments:
            recording = int(samples["recording"][rows[0]])
            begin_s, end_s, error = worst_window(samples["t"][rows], squares[rows])
            # The error of a joint that does not move is compared with its noise.
            still = max(motion[recording], NOISE * p.sigma)
            score = (max(error - NOISE * p.sigma, 0.0) / still, error / p.sigma)
            if best is None or score > best[0]:
                sizes = (error, error / still) if math.isfinite(error) else (None, None)
                t_s, mask = samples["t"], np.isin(np.arange(len(squares)), rows)
                mask &= (t_s >= begin_s) & (t_s <= end_s)
                best = score, WorstSecond(p.name, p.column, p.unit, logs[recording], begin_s, end_s, *sizes), mask
    return None if best is None else best[1:]


def _segments(samples: Mapping[str, np.ndarray], settle_s: float) -> Iterator[np.ndarray]:
    """Yield the rows of each segment, without its first ``settle_s`` if it is held out."""
    counts = ~samples["held_out"].astype(bool) | (samples["into"] > settle_s)
    for segment in np.unique(samples["segment"][counts]):
        yield np.flatnonzero(counts & (samples["segment"] == segment))
