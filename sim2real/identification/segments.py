"""Recordings cut into segments: timing, commands and measurements of each, padded to one width."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim2real import pytree
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S, BaseNode, to_ticks
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Edge, Vertex
from sim2real.identification.model import ChecksLogs, IdentifiableModel
from sim2real.later import jnp
from sim2real.types import Array, PyTree

_LEAST_SAMPLES = 4
"""Smallest number of samples around the start of a segment."""
GRID_S = 0.1
"""Segments and held-out parts begin at multiples of this time after the first one [s], so that in every segment the
messages of a regular log fall on the same ticks of a world.
"""


@dataclass(frozen=True)
class Span:
    """A segment: the number of its recording, its begin [s], and whether it is fitted; otherwise it is held out."""

    recording: int
    begin_s: float
    fitted: bool = True


@dataclass(frozen=True)
class Segments:
    """E spans of one length, side by side.

    Attributes:
        timeline: The recorded timing of sensor and given nodes, E episodes; the sensor's steps are ``ahead_s`` later.
        messages: Node -> its recorded messages, leaves ``(E, N, ...)``.
        measured: Field -> ``(E, N, ...)``.
        ts: Shape ``(E, N)``: time of each measurement [s from the segment's start]; 0 after the last.
        starts: Shape ``(E, channels, 4)``: coefficients of a cubic in time, fitted to each channel's measurements
            around the start.
    """

    spans: tuple[Span, ...]
    length_s: float
    timeline: Timeline
    messages: Mapping[str, PyTree]
    measured: Mapping[str, np.ndarray]
    ts: np.ndarray
    starts: np.ndarray


class Data(NamedTuple):
    """Segments as an argument of compiled programs, padded so that recordings of similar length share programs.

    E is the number of segments, K the number of the sensor's steps. Both are rounded up; the padding repeats the last
    entry.

    Attributes:
        tables: Timing of the simulated steps, from ``OpenLoopGraph.tables``.
        messages: Node -> its recorded messages, leaves ``(E, N, ...)``.
        measured: Field -> ``(E, K, ...)``: the measurement that each of the sensor's steps predicts.
        ts: Shape ``(E, K)``: time of this measurement [s from the segment's start]; -1 without a comparison.
        starts: Shape ``(E, channels, 4)``, as in ``Segments``.
        recording: Shape ``(E,)``: number of the segment's recording.
    """

    tables: PyTree
    messages: Mapping[str, PyTree]
    measured: Mapping[str, Array]
    ts: Array
    starts: Array
    recording: Array


def data_of(cuts: Segments, tables: PyTree, from_s: float) -> Data:
    """Return segments as an argument of compiled programs.

    Args:
        from_s: Start of the comparison [s from the segment's start].
    """
    ts = np.where(cuts.ts >= from_s, cuts.ts, -1.0)
    steps = rounded(ts.shape[1])
    ts = np.pad(ts, ((0, 0), (0, steps - ts.shape[1])), constant_values=-1.0)
    measured = {f: np.asarray(padded(rows, steps, 1), np.float32) for f, rows in cuts.measured.items()}
    messages = {
        n: pytree.map(lambda leaf: padded(leaf, rounded(leaf.shape[1]), 1), tree) for n, tree in cuts.messages.items()
    }
    rows = (tables, messages, measured, ts.astype(np.float32), np.asarray(cuts.starts, np.float32),
            np.array([s.recording for s in cuts.spans], np.int32))  # fmt: skip
    return pytree.map(jnp.asarray, Data(*padded(rows, rounded(len(cuts.spans)))))


def cut(
    model: IdentifiableModel,
    nodes: Mapping[str, BaseNode],
    recordings: Sequence[Episode],
    spans: Sequence[Span],
    length_s: float,
    lead_s: float,
) -> Segments:
    """Cut recordings into segments.

    Args:
        spans: The segments, recording by recording; those that start in a gap of the samples are skipped.
        length_s: Length of a segment [s].
        lead_s: Time before a segment from which commands are kept, as they still act in it [s].

    Raises:
        Sim2RealError: When a log lacks a node or a field, or holds NaN.
    """
    if not spans:
        raise UsageError("there is no segment to identify from")
    # Cut the recorded timing, recording by recording.
    timelines, firsts, ordered = [], [], []
    for r, episode in enumerate(recordings):
        t = episode.steps[model.sensor].begun_s if model.sensor in episode.steps else np.zeros(0)
        parts_of = [s for s in spans if s.recording == r and not _in_gap(t, s.begin_s)]
        if not parts_of:
            continue
        check_log(episode, model)
        recorded = Timeline.from_episode(episode, {n: nodes[n] for n in (model.sensor, *model.given)})
        lead = {n: to_ticks(lead_s) for n in model.given}
        parts, first = cut_timeline(recorded, [to_ticks(s.begin_s) for s in parts_of], to_ticks(length_s), lead)
        timelines.append(parts)
        firsts += [(r, {n: int(f[i]) for n, f in first.items()}) for i in range(len(parts_of))]
        ordered += parts_of
    if not ordered:
        raise UsageError("each segment would start in a gap of the log", hint="record again")
    # Stack the recordings, and take each segment's messages from its first step on.
    timeline = Timeline.stack(timelines)
    start = timeline.vertices[model.sensor].start / TICKS_PER_S

    def rows(node: str, field: str) -> np.ndarray:
        width = timeline.vertices[node].start.shape[1]
        return np.stack([_rows(recordings[r].outputs[node][field], f[node], width) for r, f in firsts])

    fields = {f for c in model.channels for f, _ in c.fields}
    return Segments(
        spans=tuple(ordered),
        length_s=length_s,
        timeline=_later(timeline, model.sensor, to_ticks(model.ahead_s)),
        messages={n: pytree.map(lambda f, n=n: rows(n, f), tree) for n, tree in model.given.items()},
        measured={f: rows(model.sensor, f) for f in sorted(fields)},
        ts=np.where(start < length_s, start, 0.0),
        starts=np.stack([_local_fit(recordings[s.recording], model, s.begin_s) for s in ordered]),
    )


def cut_timeline(
    timeline: Timeline, begins: Sequence[int], length: int, lead: Mapping[str, int]
) -> tuple[Timeline, dict[str, np.ndarray]]:
    """Cut a recorded episode into segments; in each, time starts at 0.

    Args:
        begins: Starts of the segments [ticks].
        length: Length of every segment [ticks].
        lead: Node -> time before the segment's start from which its steps are kept, at negative times [ticks].

    Returns:
        The segments as E episodes; and for each node, shape ``(E,)``, the number of the original step that is step 0 of
        each segment.
    """
    firsts = {
        n: np.searchsorted(v.start[0, : v.count[0]], np.asarray(begins) - lead.get(n, 0))
        for n, v in timeline.vertices.items()
    }
    parts = []
    for i, begin in enumerate(begins):
        vertices, edges, last = {}, {}, dict[str, int]()
        for n, v in timeline.vertices.items():
            first, last[n] = int(firsts[n][i]), int(np.searchsorted(v.start[0, : v.count[0]], begin + length))
            take = slice(first, last[n])
            vertices[n] = Vertex(v.start[:, take] - begin, v.end[:, take] - begin, np.array([last[n] - first]))
        for (n, name), e in timeline.edges.items():
            take = slice(int(firsts[e.sender][i]), last[e.sender])
            seq_in = e.seq_in[:, take]
            # A message that was consumed earlier is in the window of the segment's first step.
            inside = (seq_in >= 0) & (seq_in < last[n])
            seq_in = np.where(inside, np.maximum(seq_in - int(firsts[n][i]), 0), -1)
            edges[n, name] = Edge(e.received[:, take] - begin, seq_in, e.sender)
        parts.append(Timeline(vertices, edges))
    return Timeline.stack(parts), firsts


def _later(timeline: Timeline, node: str, ticks: int) -> Timeline:
    """Return the timeline with one node's steps later."""
    v = timeline.vertices[node]
    moved = Vertex(v.start + ticks, v.end + ticks, v.count)
    return Timeline({**timeline.vertices, node: moved}, timeline.edges)


def require_moved(episode: Episode, name: str = "the log") -> None:
    """Raise an error if no motor moved the robot: in a dry run, or in a recording by hand."""
    if episode.metadata.get("config", {}).get("excitation") == "hand":
        raise Sim2RealError(
            f"{name} was guided by hand: torque was off, and the torque of the hand was not measured",
            hint="play it and record that: `sim2real record PIPELINE --excitation LOG`",
        )
    if episode.metadata.get("dry_run") is True:
        raise Sim2RealError(
            f"{name} was recorded in a dry run: torque was off, and no command was sent",
            hint="record without --dry-run",
        )


def check_log(episode: Episode, model: IdentifiableModel) -> None:
    """Raise an error unless the log holds the sensor's channels and the commands, as numbers and not of a dry run."""
    # Steps of all nodes, then their fields, which must be finite.
    require_moved(episode)
    hint = "identify from a log of this pipeline's record stage, or one imported with its mapping"
    for name in (model.sensor, *model.given):
        if name not in episode.steps or not len(episode.steps[name]):
            raise Sim2RealError(
                f"the log has no steps of node {name!r}. Available: {', '.join(episode.steps) or 'none'}", hint=hint
            )
    wanted = [(model.sensor, f) for c in model.channels for f, _ in c.fields]
    wanted += [(node, f) for node, tree in model.given.items() for f in pytree.leaves(tree)]
    for node, field in wanted:
        data = episode.outputs[node].get(field)
        if data is None:
            raise Sim2RealError(
                f"node {node!r} has no field {field!r} in this log. Available: {', '.join(episode.outputs[node])}",
                hint=hint,
            )
        finite = np.isfinite(data.reshape(len(data), -1)).all(axis=1)
        if not finite.all():
            raise Sim2RealError(
                f"field {field!r} of node {node!r} holds values that are no numbers, the first in step "
                f"{int(np.argmin(finite))}",
                hint="record again: an identification needs finite numbers",
            )
    if isinstance(model, ChecksLogs):
        model.check(episode)


def _rows(recorded: np.ndarray, first: int, width: int) -> np.ndarray:
    """Return ``width`` recorded rows from ``first`` on; beyond the end, the last row is repeated."""
    return recorded[np.minimum(first + np.arange(width), len(recorded) - 1)]


def _near(t: np.ndarray, begin_s: float) -> np.ndarray:
    """Return the indices of up to eight samples near a start, from which its state is estimated; ``t`` ``(N,)`` [s]."""
    # Take the eight samples nearest to a point one period after the start.
    period = float(np.median(np.diff(t)))
    near = np.sort(np.argsort(np.abs(t - begin_s - period), kind="stable")[:8])
    return near[np.abs(t[near] - begin_s) < 12 * period]


def on_grid(after_s: np.ndarray | float, whole: Callable[[np.ndarray], np.ndarray] = np.round) -> np.ndarray:
    """Return times [s] rounded to the grid of segments by ``whole``, such as ``np.floor``."""
    return whole(np.round(np.asarray(after_s) / GRID_S, 5)) * GRID_S


def _in_gap(t: np.ndarray, begin_s: float) -> bool:
    """Return whether a start within a log has too few samples around it."""
    return t.size > 1 and bool(t[0] <= begin_s <= t[-1]) and _near(t, begin_s).size < _LEAST_SAMPLES


def _local_fit(episode: Episode, model: IdentifiableModel, begin_s: float) -> np.ndarray:
    """Fit a cubic in time to each channel's samples around a start; shape ``(channels, 4)``."""
    t = episode.steps[model.sensor].begun_s
    near = _near(t, begin_s)
    if near.size < _LEAST_SAMPLES:
        raise UsageError(f"the log has {near.size} measurements around {begin_s:.3f} s, too few to start a segment")
    # Fit positions, and velocities if they are measured, weighted by their deviations.
    x = (t[near] - begin_s)[:, None]
    powers = x ** np.arange(4)
    slopes = np.concatenate([np.zeros_like(x), np.ones_like(x), 2 * x, 3 * x**2], axis=1)
    fits = []
    for c in model.channels:
        data = [c.of(episode.outputs[model.sensor][f][near]) / s for f, s in c.fields]
        rows = [p / s for p, (_, s) in zip((powers, slopes), c.fields, strict=False)]
        fits.append(np.linalg.lstsq(np.concatenate(rows), np.concatenate(data), rcond=None)[0])
        # A joint that never moves starts at rest: a velocity estimated from noise would seem to determine its friction.
        (name, sigma), *_ = c.fields
        if np.ptp(c.of(episode.outputs[model.sensor][name])) < _RESTS * sigma:
            fits[-1] = np.array([data[0].mean() * sigma, 0.0, 0.0, 0.0])
    return np.stack(fits)


_RESTS = 10.0
"""A joint never moves if the range of its positions is below this [standard deviations of a measurement]."""
_RATE_S = 0.05
"""Time over which speeds are averaged for the extent of a motion [s]: noise of 1 mrad makes 28 mrad/s."""
Extent = tuple[float, float, float]
"""Lowest and highest position, and largest speed."""


def extents(
    model: IdentifiableModel, recordings: Sequence[Episode], spans: Sequence[Span], length_s: float
) -> dict[str, Extent]:
    """Return joint -> extent of its motion in some segments.

    Args:
        length_s: Length of a segment [s].
    """
    found = {}
    for c in model.channels:
        rows = []
        for span in spans:
            t = recordings[span.recording].steps[model.sensor].begun_s
            inside = (t >= span.begin_s) & (t <= span.begin_s + length_s)
            if not inside.any():
                continue
            position = c.of(recordings[span.recording].outputs[model.sensor][c.position][inside])
            grid = np.arange(t[inside][0], t[inside][-1], _RATE_S)
            speeds = np.diff(np.interp(grid, t[inside], position)) / _RATE_S
            rows.append((position.min(), -position.max(), -np.max(np.abs(speeds), initial=0.0)))
        if rows:
            low, high, fastest = np.min(rows, axis=0).tolist()
            found[c.name] = (low, -high, -fastest)
    return found


_EXACT = 4
"""Largest count that is not rounded."""


def rounded(count: int, steps: int = 4) -> int:
    """Return a count rounded up to one of ``steps`` sizes between a power of two and the next power.

    With four sizes the result is at most a quarter larger, and an eighth on average.

    Args:
        count: At least 1.
    """
    if count <= max(_EXACT, steps):
        return count
    unit = max(1, 2 ** (int(count - 1).bit_length() - 1) // steps)
    return -(-count // unit) * unit


def padded(tree: PyTree, size: int, axis: int = 0) -> PyTree:
    """Return arrays that repeat their last entry along an axis up to a size.

    Args:
        size: At least the length along the axis.
    """

    def one(leaf: np.ndarray) -> np.ndarray:
        width = [(0, size - leaf.shape[i]) if i == axis else (0, 0) for i in range(leaf.ndim)]
        return np.pad(leaf, width, mode="edge")

    return pytree.map(lambda leaf: one(np.asarray(leaf)), tree)
