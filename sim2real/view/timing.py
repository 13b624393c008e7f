"""Timing of a log on a page: the schedule as a figure, a row of numbers for each node, and the parts of the delay."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, replace
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Spread, Timing
from sim2real.graph.episode import Episode, Steps
from sim2real.graph.node import TICKS_PER_S
from sim2real.log.session import is_imported
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR
from sim2real.types import Json
from sim2real.view import style
from sim2real.view.blocks import MISSING, Block, FigureBlock, TableBlock, Tile, fixed
from sim2real.view.graphs import draw_messages
from sim2real.view.style import BLUE, MUTED, ORANGE, new_figure, styled, to_svg

_PERIODS_SHOWN = 4.5
_CHAIN = (SENSOR, AGENT, ACTUATOR)
"""The nodes that a measurement passes on its way to a motor."""


def timing_tiles(episodes: Sequence[Episode]) -> Iterator[Tile]:
    """Yield the worst lateness, the oldest input and the overruns of some episodes; nothing for imported logs."""
    if any(map(is_imported, episodes)):
        return
    nodes = [(name, node) for e in episodes for name, node in Timing.of(e).nodes.items()]
    if any(is_virtual(e) for e in episodes):
        yield Tile("lateness", "none", "an embedded robot runs in virtual time")
    else:
        worst_s, name = max((node.lateness.p99, name) for name, node in nodes if node.lateness.p99 is not None)
        yield Tile("lateness, p99", f"{1e3 * worst_s:.2f} ms", f"of {name}, the worst node")
    # Lateness does not show old messages, so show the oldest input, too.
    if old := [(age.max, name) for name, node in nodes for age in node.age.values() if age.max is not None]:
        oldest_s, name = max(old)
        yield Tile("oldest input of a step", f"{1e3 * oldest_s:.1f} ms", f"of {name}")
    if overruns := [node.overruns for _, node in nodes if node.overruns is not None]:
        end: Mapping[str, Json] = episodes[-1].metadata.get("log", {}).get("session_end") or {}
        lost = end.get("lost_replies")  # each log has the count of the whole session
        yield Tile("overruns", str(sum(overruns)), f"{lost} lost replies" if lost is not None else "")


def is_virtual(episode: Episode) -> bool:
    """Return whether an episode ran in the virtual time of an embedded robot, in which no thread is late."""
    return episode.metadata.get("port") == "embedded"


def timing_blocks(episode: Episode, name: str, which: str = "", folded: bool = False) -> list[Block]:
    """Return schedule and table of an episode's timing; nothing for an imported log, which has only stamps."""
    if is_imported(episode):
        return []
    caption = f"Timing of each node [ms]{which and ',' + which.lower().rstrip('.')}"
    table = replace(TableBlock.of(caption, Timing.of(episode).rows()), folded=folded)
    if folded:
        return [table]
    caption = (
        f"Computation of each node over time.{which} A line is a message on its way, dotted until a step reads it."
    )
    return [FigureBlock(schedule(episode, f"{name}-schedule"), caption), table]


def schedule(episode: Episode, name: str) -> str:
    """Draw when nodes computed and waited, around the latest wake-up, or in virtual time in the episode's middle."""
    nodes = [n for n in in_order(episode) if len(episode.steps[n])]
    periods = [float(np.median(np.diff(s.start))) for s in episode.steps.values() if len(s) > 1]
    length = _PERIODS_SHOWN * max(periods, default=1e6 * episode.duration_s)
    late = {n: episode.steps[n].woken - episode.steps[n].start for n in nodes}
    worst = max(nodes, key=lambda n: late[n].max())
    title = f"Around the latest wake-up: {worst}, {late[worst].max() / 1e3:.1f} ms"
    begin = max(0, int(episode.steps[worst].start[late[worst].argmax()]) - int(0.4 * length))
    if is_virtual(episode):
        begin = int(1e6 * episode.duration_s / 2)
        title = f"At {begin / 1e6:.1f} s"
    with styled():
        figure = new_figure(0.9 + 0.4 * len(nodes), style.PHONE_IN)
        axes = figure.subplots()
        for row, node in enumerate(nodes):
            _bars(axes, episode.steps[node], row, begin, begin + length)
        _messages(axes, episode, nodes, begin, begin + length)
        axes.set(title=title, xlabel=f"time since {begin / 1e6:.3f} s [ms]", xlim=(0, length / 1e3))
        axes.set_yticks(range(len(nodes)), nodes)
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(nodes) - 0.5, -0.6)
        entries = [
            Patch(facecolor=BLUE, label="computing"),
            Patch(facecolor=ORANGE, label="late wake-up"),
            Patch(facecolor="none", edgecolor=MUTED, hatch="////", label="waiting for its inputs"),
        ]
        style.legend_above(figure, entries)
        return to_svg(figure, name, "An excerpt of the schedule: when each node waited and computed, and its messages")


def _bars(axes: Axes, steps: Steps, row: int, begin: float, end: float) -> None:
    """Draw the steps of one node that overlap an interval [us]."""
    # Draw waiting from the previous step's end: after an overrun, a step is due before that end.
    free = np.concatenate([[0], steps.end[:-1]])
    due_at = np.minimum(np.maximum(steps.scheduled + steps.drift, free), steps.start)
    near = (steps.end >= begin) & (due_at <= end)
    due, start, woken, done = ((values[near] - begin) / 1e3 for values in (due_at, steps.start, steps.woken, steps.end))
    kinds: tuple[tuple[np.ndarray, np.ndarray, dict[str, Any]], ...] = (
        (due, start, {"facecolor": "none", "edgecolor": MUTED, "hatch": "////", "lw": 0.6}),
        (start, woken, {"facecolor": ORANGE}),
        (woken, done, {"facecolor": BLUE, "edgecolor": BLUE, "lw": 0.8}),  # an edge keeps short steps visible
    )
    for first, last, look in kinds:
        wide = last > first
        axes.broken_barh(list(zip(first[wide], (last - first)[wide], strict=True)), (row - 0.28, 0.56), **look)


def _messages(axes: Axes, episode: Episode, nodes: list[str], begin: float, end: float) -> None:
    """Draw the messages between nodes in an interval [us]."""
    graph = episode.metadata.get("graph", {})
    for (node, input_name), messages in episode.messages.items():
        sender = graph.get(node, {}).get("inputs", {}).get(input_name, {}).get("from")
        if sender not in nodes or node not in nodes:
            continue
        starts = episode.steps[node].start
        seq_in = messages.seq_in - int(episode.metadata.get("log", {}).get("first_seq", {}).get(node, 0))
        read = (messages.sent >= begin) & (messages.seq_in >= 0) & (seq_in >= 0) & (seq_in < len(starts))
        used = starts[np.where(read, seq_in, 0)]
        read &= used <= end
        times = ((values[read] - begin) / 1e3 for values in (messages.sent, messages.received, used))
        draw_messages(axes, (nodes.index(sender), nodes.index(node)), *times, color=MUTED)


def delay_blocks(recording: Recording, identification: Identification | None) -> list[Block]:
    """Return the table of the delay's parts; nothing for an imported log, which has only stamps.

    Args:
        identification: Identification of this robot, which has the device's share; None: the share is unknown.
    """
    episode = recording.episode
    if is_imported(episode) or not set(_CHAIN) <= set(episode.steps):
        return []
    rows, sum_s = [], 0.0
    for name, where, times_s, counted in parts_of(recording):
        spread = Spread.of(times_s)
        sum_s += (spread.p50 or 0.0) if counted else 0.0
        cells = [MISSING if s is None else fixed(1e3 * s, 2) for s in astuple(spread)]
        rows.append([name, where if counted else f"({where})", *cells])
    # This computer cannot measure the rest: from a motion to its sample, and from a command to the motion.
    rows_of = identification.parameters if identification else ()
    whole = "sum of the medians, without the device and parts in ()"
    if (device := next((p for p in rows_of if p.name == ROUND_TRIP), None)) is not None:
        rows.append([f"{device.about}, from the motion", "device", fixed(1e3 * device.estimate, 2), MISSING, MISSING])
        sum_s, whole = sum_s + device.estimate, "sum of the medians, without parts in ()"
    rows.append([whole, "", fixed(1e3 * sum_s, 2), MISSING, MISSING])
    caption = "Delay from a motion to the motion that answers it [ms]"
    return [TableBlock(caption, ("part", "where", "p50", "p99", "max"), rows, text_columns=(1,))]


def parts_of(recording: Recording) -> Iterator[tuple[str, str, np.ndarray, bool]]:
    """Yield the measured parts: name, ``host`` or ``bus``, times ``(N,)`` [s], and whether the part counts in the sum.

    The sensor's request on the bus does not count, because it comes before the sample.
    """
    timing, steps = recording.timing, recording.episode.steps[SENSOR]
    yield f"{SENSOR}, from the sample to its message", "host", (steps.end - steps.begun) / TICKS_PER_S, True
    if (bus := timing.bus_s.get(SENSOR)) is not None and bus.size:
        yield f"{SENSOR} on the bus, question and answer", "bus", bus, False
    for before, name in pairwise(_CHAIN):
        if (under_way := timing.transport_s.get(f"{name}/{before}")) is not None:
            yield f"message from {before} to {name}", "host", under_way, True
        whole, bus = timing.steps_s[name], timing.bus_s.get(name)
        if bus is None or not bus.size:
            yield f"{name} wakes and computes", "host", whole, True
        elif bus.size == whole.size:
            yield f"{name} wakes and computes", "host", whole - bus, True
            yield f"{name} on the bus", "bus", bus, True
        else:
            yield f"{name}, its transactions included", "bus", whole, True


def in_order(episode: Episode) -> list[str]:
    """Return the nodes' names: first those with an ``order``, then the others, senders before readers if possible."""
    senders: Mapping[str, set[str]] = {
        n: {i["from"] for i in node.get("inputs", {}).values()} for n, node in episode.metadata.get("graph", {}).items()
    }
    order: list[str] = []
    remaining = list(episode.steps)
    while remaining:
        ready = [n for n in remaining if not (senders.get(n, set()) & set(remaining) - {n})] or remaining
        order.append(ready[0])
        remaining.remove(ready[0])
    orders = {n: node.get("order") for n, node in episode.metadata.get("graph", {}).items()}
    place = {n: orders[n] if isinstance(orders.get(n), int) else math.inf for n in order}
    return sorted(order, key=lambda n: place[n])  # a stable sort
