"""Predictions of a model, their errors over horizons, and baselines without a model beside them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from sim2real.artifacts.identification import WorstSecond, worst_window
from sim2real.graph.node import TICKS_PER_S
from sim2real.identification.model import IdentifiableModel, position_of
from sim2real.identification.residuals import Problem
from sim2real.log.schema import unit_of

GOAL = "told"
"""Name of the baseline that takes the newest goal for the position."""
_RUNG, _LEAST_RUNG, _SLOWEST_HZ, _DAMPED = 20, 30, 2.5, 0.05
"""Most segments in which a resonance is looked for, fewest samples of one; lowest frequency; damping ratio."""
NOISE = 2.0
"""Errors below this many deviations of the measurement count as noise."""


@dataclass(frozen=True)
class Position:
    """A measured position that is judged.

    Attributes:
        column: Its name in tables of errors, ``position[1]``.
        name: Its name for people.
        sigma: Deviation of a measurement.
    """

    column: str
    name: str
    unit: str
    sigma: float


@dataclass(frozen=True)
class Prediction:
    """Errors of a model on held-out segments up to a horizon: field -> root mean square error; None without data."""

    model: str
    horizon_s: float
    rmse: Mapping[str, float | None]


def positions(model: IdentifiableModel, units: Mapping[str, str]) -> list[Position]:
    """Return the measured positions of a model, which are judged one by one.

    Args:
        units: Field -> unit.
    """
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
        the measurement ``FIELD_measured`` and each prediction ``FIELD_MODEL``. If commands are positions, the goal of
        the joint is in the column of the baseline ``told``.
    """
    held_out = ~np.isin(np.arange(problem.segments), problem.train) if held_out is None else held_out
    every, fit_s = np.arange(problem.segments), np.where(held_out, settle_s, problem.segment_s)
    columns: dict[str, np.ndarray] = {}
    # Simulate the segments with each model; the first one fixes the columns of all.
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
    problem: Problem,
    columns: Mapping[str, np.ndarray],
    models: Sequence[str],
    settle_s: float,
    horizons: Sequence[float],
) -> list[Prediction]:
    """Return each model's error over each horizon, on held-out segments.

    The baseline ``hold`` keeps the last measurement. If commands are positions, the second baseline is the goal itself.

    Args:
        columns: Result of ``samples``.
        settle_s: First part of held-out segments, to which initial states were fitted; horizons begin at its end [s].
        horizons: Horizons [s].
    """
    ahead = columns["into"] - settle_s
    names = labels(problem)
    rows = []
    for model in (*models, *_baselines(columns)):
        predicted = {n: p for n in names if (p := _predicted(columns, n, model, ahead)) is not None}
        for horizon_s in horizons:
            pick = columns["held_out"].astype(bool) & (ahead > 0) & (ahead <= horizon_s)
            off = {n: (p - columns[f"{n}_measured"])[pick] for n, p in predicted.items()}
            rmse = {n: float(np.sqrt(np.mean(o**2))) if o.size else None for n, o in off.items()}
            rows.append(Prediction(model, horizon_s, rmse))
    return rows


def _baselines(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of the baselines: ``hold``, and that of the goal if commands are positions."""
    return ["hold", *([GOAL] if any(n.endswith(f"_{GOAL}") for n in columns) else [])]


def _predicted(columns: Mapping[str, np.ndarray], field: str, model: str, ahead: np.ndarray) -> np.ndarray | None:
    """Return a model's prediction ``(N,)``; None without a prediction of the field.

    ``hold`` keeps the last measurement before the horizon.
    """
    if model != "hold":
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
    samples: Mapping[str, np.ndarray], positions: Sequence[Position], settle_s: float
) -> WorstSecond | None:
    """Return the worst second of all joints, recordings and segments, fitted and held-out ones; None without samples.

    The second with the largest error beyond the noise, as a share of the joint's motion, is the worst: so a joint that
    moves little, and a joint that moves much, can both be it. If all errors are noise, it is the second with the
    largest error in deviations of a measurement.

    Args:
        samples: Result of ``prediction.samples``.
        settle_s: First part of held-out segments, to which initial states were fitted; it does not count [s].
    """
    best: tuple[tuple[float, float], WorstSecond] | None = None
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
            # A joint that does not move is compared with its noise.
            still = max(motion[recording], NOISE * p.sigma)
            score = (max(error - NOISE * p.sigma, 0.0) / still, error / p.sigma)
            if best is None or score > best[0]:
                sizes = (error, error / still) if math.isfinite(error) else (None, None)
                segment = int(samples["segment"][rows[0]])
                best = score, WorstSecond(p.name, p.column, p.unit, recording, segment, begin_s, end_s, *sizes)
    return None if best is None else best[1]


def _segments(samples: Mapping[str, np.ndarray], settle_s: float) -> Iterator[np.ndarray]:
    """Yield the rows of each segment that count."""
    counts = ~samples["held_out"].astype(bool) | (samples["into"] > settle_s)
    for segment in np.unique(samples["segment"][counts]):
        yield np.flatnonzero(counts & (samples["segment"] == segment))


def ringing(samples: Mapping[str, np.ndarray], column: str) -> tuple[float, float]:
    """Return the largest share of a position's residuals that one resonance explains, and its frequency [Hz].

    A transmission that gives way moves the link beside its drive by y, with y'' + 2 d w y' + w^2 y = -q'' for the
    predicted motion q. At each frequency y and y' are fitted beside speed, acceleration, dry friction and the free
    oscillation of each segment. Belts explained 0.37 and more, joints of five real robots 0.27 at most.
    """
    from scipy.signal import cont2discrete, lfilter  # 0.2 s

    # Put the fitted segments onto one grid of time.
    chosen = np.unique(samples["segment"][~samples["held_out"].astype(bool)])
    rows = [np.flatnonzero(samples["segment"] == s) for s in chosen[:: -(-len(chosen) // _RUNG) or 1]]
    into = [samples["into"][r].astype(np.float64) for r in rows]
    if not rows or min(map(len, into)) < _LEAST_RUNG:
        return 0.0, 0.0
    step_s, length_s = float(np.median(np.diff(into[0]))), min(float(t[-1] - t[0]) for t in into)
    grid = np.arange(0.0, length_s, step_s)
    parts = list(zip(into, rows, strict=True))
    at = lambda name: np.stack([np.interp(grid, t - t[0], samples[name][r]) for t, r in parts])  # noqa: E731
    predicted = at(f"{column}_identified")
    off = at(f"{column}_measured") - predicted
    if not np.isfinite(predicted).all():
        return 0.0, 0.0
    speed = np.gradient(predicted, step_s, axis=1)
    acceleration, best = np.gradient(speed, step_s, axis=1), (0.0, 0.0)
    for hz in np.geomspace(_SLOWEST_HZ, max(min(0.35 / step_s, 60.0), _SLOWEST_HZ), 25):
        w = 2.0 * np.pi * float(hz)
        discrete: Any = cont2discrete(([1.0], [1.0, 2.0 * _DAMPED * w, w * w]), step_s, "foh")
        beside = lfilter(discrete[0].ravel(), discrete[1], -acceleration, axis=1)
        free = np.exp(-_DAMPED * w * grid)
        own = np.stack([grid**0, grid, free * np.cos(w * grid), free * np.sin(w * grid)], axis=1)
        basis = np.linalg.qr(own)[0]
        columns = (speed, acceleration, np.sign(speed), beside, np.gradient(beside, step_s, axis=1))
        r, *J = (v - v @ basis @ basis.T for v in (off, *columns))
        J = np.stack([j.ravel() / (np.linalg.norm(j) + 1e-12) for j in J], axis=1)
        squares = [
            float(np.sum((r.ravel() - c @ np.linalg.lstsq(c, r.ravel(), rcond=None)[0]) ** 2)) for c in (J[:, :3], J)
        ]
        best = max(best, (1.0 - squares[1] / max(squares[0], 1e-300), float(hz)))
    return best
