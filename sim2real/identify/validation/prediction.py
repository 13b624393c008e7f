"""How well a model predicts, over horizons and in free runs, beside baselines that need no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.identification import FreeRun, Prediction
from sim2real.graph.node import TICKS_PER_S
from sim2real.identify.model import Channel
from sim2real.identify.problem.problem import Problem

Values = Mapping[str, Any]


def samples(
    problem: Problem, models: Mapping[str, Values], settle_s: float, held_out: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Simulate all segments with each model; initial states of held-out segments are fitted to their first part alone.

    Args:
        settle_s: Length of that first part [s].
        held_out: Shape ``(S,)``, bool: which segments count as held out; default: those that are not fitted.

    Returns:
        Columns ``(N,)``: ``t`` and ``into`` [s], ``segment``, ``recording``, ``held_out``; for each channel's field
        what was ``measured`` and what each model says, as ``FIELD_measured``, ``FIELD_MODEL``. ``FIELD_told`` is where
        a joint was told to be at that time, where commands are positions.
    """
    held_out = ~np.isin(np.arange(problem.segments), problem.train) if held_out is None else held_out
    every, fit_s = np.arange(problem.segments), np.where(held_out, settle_s, problem.segment_s)
    columns: dict[str, np.ndarray] = {}
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
            columns |= _told(problem, segment, into)
        for i, (label, (_, sigma, _)) in enumerate(zip(labels(problem), problem.fields, strict=True)):
            columns[f"{label}_{name}"] = columns[f"{label}_measured"] + residuals[..., i][at] * sigma
    return columns


def _told(problem: Problem, segment: np.ndarray, into: np.ndarray) -> dict[str, np.ndarray]:
    """Return the newest goal sent before each sample, ``LABEL_told`` for each channel that is told where to be."""
    columns = {}
    for c in problem.channels:
        if c.goal is None:
            continue
        node, place = next(
            (n, fields.index(c.goal))
            for n, tree in problem.model.given.items()
            if c.goal in (fields := jax.tree_util.tree_leaves(tree))
        )
        rows = np.asarray(jax.tree_util.tree_leaves(problem.given[node])[place])
        sent_s = problem.timeline.vertices[node].end / TICKS_PER_S
        told = np.empty(len(into))
        for s in np.unique(segment):
            own = segment == s
            newest = np.searchsorted(sent_s[s], into[own], side="right") - 1
            told[own] = c.of(rows[s])[np.maximum(newest, 0)]
        columns[f"{position_of(c)}_told"] = told
    return columns


def position_of(channel: Channel) -> str:
    """Return the name of a channel's position among the columns."""
    return channel.position if channel.index is None else f"{channel.position}[{channel.index}]"


def labels(problem: Problem) -> list[str]:
    """Return a name for each column of the residuals: the field, with the channel's index where it is a vector."""
    return [f if c.index is None else f"{f}[{c.index}]" for c in problem.channels for f, _ in c.fields]


def errors(
    problem: Problem,
    columns: Mapping[str, np.ndarray],
    models: Sequence[str],
    settle_s: float,
    horizons: Sequence[float],
) -> list[Prediction]:
    """Return each model's error over each horizon, on fitted and on held-out segments.

    Two baselines stand beside the models: ``hold`` (nothing changes) and, where commands are positions, ``told`` (every
    joint is where it was told to be).

    Args:
        columns: What ``samples`` returned.
        settle_s: First part of held-out segments, to which initial states were fitted: horizons begin at its end [s].
        horizons: How far ahead [s].
    """
    ahead = columns["into"] - settle_s
    names = labels(problem)
    rows = []
    for model in (*models, *_baselines(columns)):
        predicted = {n: p for n in names if (p := _predicted(columns, n, model, ahead)) is not None}
        for horizon_s in horizons:
            for held_out in (False, True):
                pick = (columns["held_out"] == held_out) & (ahead > 0) & (ahead <= horizon_s)
                off = {n: (p - columns[f"{n}_measured"])[pick] for n, p in predicted.items()}
                rmse = {n: float(np.sqrt(np.mean(o**2))) if o.size else None for n, o in off.items()}
                mae = {n: float(np.mean(np.abs(o))) if o.size else None for n, o in off.items()}
                rows.append(Prediction(model, horizon_s, held_out, rmse, mae))
    return rows


def _baselines(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Return the baselines: ``hold``, and ``told`` where commands are positions."""
    return ["hold", *(["told"] if any(n.endswith("_told") for n in columns) else [])]


def free_runs(
    columns: Mapping[str, np.ndarray], names: Sequence[str], models: Sequence[str], settle_s: float
) -> list[FreeRun]:
    """Return the errors of whole segments, each by itself.

    Args:
        columns: What ``samples`` returned, of long segments.
        models: Names of the models; the baselines are added.
        settle_s: First part of a segment, which does not count [s].
    """
    rows = []
    ahead = columns["into"] - settle_s
    for segment in np.unique(columns["segment"]):
        pick = (columns["segment"] == segment) & (ahead > 0)
        if not pick.any():
            continue
        t = columns["t"][pick]
        about: dict[str, Any] = {
            "recording": int(columns["recording"][pick][0]),
            "begin_s": float(t[0]),
            "seconds": float(t[-1] - t[0]),
            "held_out": bool(columns["held_out"][pick][0]),
        }
        for model in (*models, *_baselines(columns)):
            for name in names:
                predicted = _predicted(columns, name, model, ahead)
                if predicted is None:
                    continue
                off = (predicted - columns[f"{name}_measured"])[pick]
                rmse, mae = float(np.sqrt(np.mean(off**2))), float(np.mean(np.abs(off)))
                rows.append(FreeRun(model=model, field=name, rmse=rmse, mae=mae, **about))
    return rows


def _predicted(columns: Mapping[str, np.ndarray], field: str, model: str, ahead: np.ndarray) -> np.ndarray | None:
    """Return a model's prediction ``(N,)``, None where it has none of this field.

    ``hold`` says that nothing changes after the last measurement before the horizon.
    """
    if model != "hold":
        return columns.get(f"{field}_{model}")
    predicted = np.zeros_like(ahead)
    for segment in np.unique(columns["segment"]):
        rows = np.flatnonzero(columns["segment"] == segment)
        past = rows[ahead[rows] <= 0]
        predicted[rows] = columns[f"{field}_measured"][past[-1] if past.size else rows[0]]
    return predicted
