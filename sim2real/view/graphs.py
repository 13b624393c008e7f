"""Pictures of a graph of nodes and of its timeline, for a notebook."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import is_color_like
from matplotlib.figure import Figure

from sim2real.errors import UsageError
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, by_name
from sim2real.graph.schedule import topological
from sim2real.graph.timeline import Timeline
from sim2real.view.style import BLUE, GRID, INK, MUTED, ORANGE, new_figure, styled

_BAR = 0.34
_WIDE, _HIGH = 3.2, 1.9


class Picture:
    """A figure that a notebook shows."""

    def __init__(self, figure: Figure) -> None:
        self.figure = figure

    def save(self, path: Path | str) -> None:
        """Write the picture, as SVG, PNG or PDF by the file's name."""
        self.figure.savefig(path)

    def _repr_svg_(self) -> str:
        text = io.StringIO()
        self.figure.savefig(text, format="svg")
        return text.getvalue()

    def __repr__(self) -> str:
        return "Picture(save(FILE) writes it)"


def plot_timeline(
    timeline: Timeline, episode: int = 0, begin_s: float = 0.0, end_s: float = 0.2, order: Sequence[str] = ()
) -> Picture:
    """Draw the steps of a timeline, and the messages between them.

    Args:
        begin_s: Start of the drawn interval [s].
        end_s: End of the drawn interval [s].
        order: The nodes from top to bottom; default: as in the timeline.

    Returns:
        A bar for each step, a line for each message from its sending to its arrival, and a dotted line to the start of
        the step that uses it.

    Raises:
        UsageError: The episode, a node or the interval does not exist.
    """
    if not 0 <= episode < timeline.episodes:
        raise UsageError(f"there is no episode {episode}: the timeline has {timeline.episodes}")
    if not begin_s < end_s:
        raise UsageError(f"the interval from {begin_s} to {end_s} s is empty", hint="begin_s must be below end_s")
    names = list(order or timeline.vertices)
    if unknown := [n for n in names if n not in timeline.vertices]:
        raise UsageError(f"the timeline has no node {', '.join(unknown)}. Nodes: {', '.join(timeline.vertices)}")
    lanes = {name: float(len(names) - 1 - i) for i, name in enumerate(names)}
    with styled():
        figure = new_figure(0.6 + 0.55 * len(names))
        axes = figure.subplots()
        # Draw the steps of each node as bars.
        for name, y in lanes.items():
            v = timeline.vertices[name]
            start, end = (t[episode, : v.count[episode]] / TICKS_PER_S for t in (v.start, v.end))
            visible = (end >= begin_s) & (start <= end_s)
            # Draw a step without duration as a thin line.
            spans = [
                (s, max(e - s, 1e-3 * (end_s - begin_s))) for s, e in zip(start[visible], end[visible], strict=True)
            ]
            axes.broken_barh(spans, (y - _BAR / 2, _BAR), facecolors=BLUE, edgecolors=INK, linewidth=0.4)
        # Draw the messages between the drawn nodes.
        for (reader, _), edge in timeline.edges.items():
            if reader in lanes and edge.sender in lanes:
                read = np.flatnonzero(edge.seq_in[episode] >= 0)
                sent, received = timeline.vertices[edge.sender].end[episode, read], edge.received[episode, read]
                used = timeline.vertices[reader].start[episode, edge.seq_in[episode, read]]
                near = (used >= begin_s * TICKS_PER_S) & (sent <= end_s * TICKS_PER_S)
                sent, received, used = (times[near] / TICKS_PER_S for times in (sent, received, used))
                draw_messages(axes, (lanes[edge.sender], lanes[reader]), sent, received, used)
        axes.set_yticks(list(lanes.values()), list(lanes))
        axes.set_xlim(begin_s, end_s)
        axes.set_ylim(-0.6, len(names) - 0.4)
        axes.set_xlabel("time since the episode's start [s]")
        axes.grid(axis="x", color=GRID)
    return Picture(figure)


def plot_graph(nodes: Mapping[str, BaseNode] | Sequence[BaseNode]) -> Picture:
    """Draw the nodes of a graph with their rates, and the connections with their options.

    Senders are left of their readers, unless ``order`` differs. A dashed arrow is a skipped connection, a thick arrow a
    blocking one.
    """
    by_node = by_name(nodes)
    names = topological(by_node)
    names.sort(key=lambda n: (by_node[n].order is None, by_node[n].order or 0))
    places = {name: _WIDE * i for i, name in enumerate(names)}
    with styled():
        figure = new_figure(3.2, max(4.0, 1.9 * len(names)))
        axes = figure.subplots()
        # Draw the nodes as boxes, then the connections as arcs.
        for name, x in places.items():
            configured = by_node[name].color
            color = configured if configured is not None and is_color_like(configured) else BLUE
            box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": color, "linewidth": 1.6}
            axes.text(x, 0.0, f"{name}\n{by_node[name].rate:g} Hz", ha="center", va="center", color=INK, bbox=box)
        for node in by_node.values():
            for i, c in enumerate(node.inputs.values()):
                _draw_connection(axes, places[c.output_node.name], places[node.name], i, c)
        axes.set_xlim(-_WIDE / 2, _WIDE * (len(names) - 0.5))
        axes.set_ylim(-_HIGH, _HIGH)
        axes.axis("off")
    return Picture(figure)


def _draw_connection(axes: Axes, begin: float, end: float, number: int, connection: Connection) -> None:
    """Draw an arc: to the right above the nodes, to the left below."""
    ahead = end > begin
    height = 0.25 + 0.07 * number
    arrow = {
        "arrowstyle": "->",
        "color": ORANGE if connection.blocking else MUTED,
        "linestyle": "--" if connection.skip else "-",
        "linewidth": 1.8 if connection.blocking else 1.0,
        "connectionstyle": f"arc3,rad={-height}",
        "shrinkA": 26,
        "shrinkB": 26,
    }
    axes.annotate("", xy=(end, 0.0), xytext=(begin, 0.0), arrowprops=arrow)
    # Label the arc with delay, window and options.
    words = [f"{1e3 * connection.delay:.3g} ms"]
    words += [f"window {connection.window}"] * (connection.window > 1)
    words += [word for word in ("blocking", "skip", "trainable") if getattr(connection, word)]
    away = 0.4 + height * abs(end - begin) / 4
    at = ((begin + end) / 2, away if ahead else -away)
    axes.text(*at, ", ".join(words), ha="center", va="bottom" if ahead else "top", color=MUTED)


def draw_messages(
    axes: Axes, rows: tuple[float, float], sent: np.ndarray, received: np.ndarray, used: np.ndarray, color: str = ORANGE
) -> None:
    """Draw messages ``(N,)``: a line from sending to arrival, then a dotted line to the step that reads it.

    Args:
        rows: Heights of the sender and of the reader.
    """
    top, bottom = rows
    side = _BAR / 2 if bottom > top else -_BAR / 2
    for at, arrived, read in zip(sent, received, used, strict=True):
        axes.plot([at, arrived], [top + side, bottom - side], color=color, linewidth=0.8)
        axes.plot([arrived, read], [bottom - side] * 2, color=color, linewidth=0.8, linestyle=":")
