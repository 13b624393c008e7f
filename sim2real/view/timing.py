"""Timing of a log on a page: the schedule as a figure, and a row of numbers for each node."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from sim2real.artifacts.timing import Timing
from sim2real.graph.episode import Episode, Steps
from sim2real.log.session import is_imported
from sim2real.types import Json
from sim2real.view import style
from sim2real.view.blocks import Block, FigureBlock, TableBlock, Tile
from sim2real.view.node_looks import color_of, in_order, slowest_period_s
from sim2real.view.style import BLUE, MUTED, ORANGE, new_figure, styled, to_svg

_PERIODS_SHOWN = 4.5


def timing_tiles(episodes: Sequence[Episode]) -> Iterator[Tile]:
    """Yield the worst lateness, the oldest input and the overruns of some episodes; nothing of an imported log."""
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
        lost = end.get("lost_replies")  # the count covers all episodes of a session
        yield Tile("overruns", str(sum(overruns)), f"{lost} lost replies" if lost is not None else "")


def is_virtual(episode: Episode) -> bool:
    """Return whether an episode is one of an embedded robot, on whose clock no thread is late."""
    return episode.metadata.get("port") == "embedded"


def timing_blocks(episode: Episode, name: str, which: str = "", folded: bool = False) -> list[Block]:
    """Return schedule and table of an episode's timing; nothing of an imported log, whose steps have stamps alone."""
    if is_imported(episode):
        return []
    caption = f"Timing of each node [ms]{which and ',' + which.lower().rstrip('.')}"
    table = replace(TableBlock.of(caption, Timing.of(episode).rows()), folded=folded)
    if folded:
        return [table]
    caption = (
        f"Computation of each node over time.{which} An arrow is a message, from the end of the sender's step to the "
        "start of the reader's step."
    )
    return [FigureBlock(schedule(episode, f"{name}-schedule"), caption), table]


def schedule(episode: Episode, name: str) -> str:
    """Draw when nodes computed and waited, in an episode's middle and, in real time, around the latest wake-up."""
    nodes = [n for n in in_order(episode) if len(episode.steps[n])]
    length = _PERIODS_SHOWN * 1e6 * slowest_period_s(episode)
    # Find the latest wake-up, which the lower plot shows.
    late = {n: episode.steps[n].woken - episode.steps[n].start for n in nodes}
    worst = max(nodes, key=lambda n: late[n].max())
    moment = int(episode.steps[worst].start[late[worst].argmax()])
    middle = int(1e6 * episode.duration_s / 2)
    with styled():
        titles = [f"At {middle / 1e6:.1f} s", f"Around the latest wake-up: {worst}, {late[worst].max() / 1e3:.1f} ms"]
        titles = titles[:1] if is_virtual(episode) else titles
        figure = new_figure((1.5 + 0.75 * len(nodes)) * len(titles) / 2 + 0.2, style.PHONE_IN)
        grid = figure.subplots(len(titles), 1, sharey=True, squeeze=False)[:, 0]
        # Draw steps as bars and messages as arrows, in the middle and around the latest wake-up.
        begins = (middle, max(0, moment - int(0.4 * length)))
        for axes, begin, title in zip(grid, begins, titles, strict=False):
            for row, node in enumerate(nodes):
                look = color_of(episode, node, BLUE)
                _bars(axes, episode.steps[node], row, begin, begin + length, look)
            _arrows(axes, episode, nodes, begin, begin + length)
            axes.set(title=title, xlabel=f"time since {begin / 1e6:.3f} s [ms]", xlim=(0, length / 1e3))
            axes.set_yticks(range(len(nodes)), nodes)
            axes.grid(False, axis="y")
            axes.tick_params(axis="y", length=0)
        grid[0].set_ylim(len(nodes) - 0.5, -0.6)
        own_colors = any(color_of(episode, n, BLUE) != BLUE for n in nodes)
        entries = [
            Patch(facecolor=BLUE, label="computing, or in the node's own colour" if own_colors else "computing"),
            Patch(facecolor=ORANGE, label="late wake-up"),
            Patch(facecolor="none", edgecolor=MUTED, hatch="////", label="waiting for its inputs"),
        ]
        style.legend_above(figure, entries)
        return to_svg(figure, name, "Excerpts of the schedule: when each node waited and computed, and its messages")


def _bars(axes: Axes, steps: Steps, row: int, begin: float, end: float, color: str) -> None:
    """Draw the steps of one node that overlap an interval [us]; computation is drawn in ``color``."""
    # Draw the waiting from the previous step's end on, as after an overrun a step is due before it.
    free = np.concatenate([[0], steps.end[:-1]])
    due_at = np.minimum(np.maximum(steps.scheduled + steps.drift, free), steps.start)
    near = (steps.end >= begin) & (due_at <= end)
    due, start, woken, done = ((values[near] - begin) / 1e3 for values in (due_at, steps.start, steps.woken, steps.end))
    kinds: tuple[tuple[np.ndarray, np.ndarray, dict[str, Any]], ...] = (
        (due, start, {"facecolor": "none", "edgecolor": MUTED, "hatch": "////", "lw": 0.6}),
        (start, woken, {"facecolor": ORANGE}),
        (woken, done, {"facecolor": color, "edgecolor": color, "lw": 0.8}),  # edge: keeps short steps visible
    )
    for first, last, look in kinds:
        wide = last > first
        axes.broken_barh(list(zip(first[wide], (last - first)[wide], strict=True)), (row - 0.28, 0.56), **look)


def _arrows(axes: Axes, episode: Episode, nodes: list[str], begin: float, end: float) -> None:
    """Draw the messages in an interval as arrows, from the sender's end to the reader's start."""
    graph = episode.metadata.get("graph", {})
    for (node, input_name), messages in episode.messages.items():
        sender = graph.get(node, {}).get("inputs", {}).get(input_name, {}).get("from")
        if sender not in nodes or node not in nodes:
            continue
        read = (messages.sent >= begin) & (messages.received <= end) & (messages.seq_in >= 0)
        rows = nodes.index(sender), nodes.index(node)
        down = 1 if rows[1] > rows[0] else -1
        first = int(episode.metadata.get("log", {}).get("first_seq", {}).get(node, 0))
        starts = episode.steps[node].start
        # Draw an arrow from the sender's end to the start of the step that uses the message.
        for sent, seq_in in zip(messages.sent[read], messages.seq_in[read] - first, strict=True):
            if not 0 <= seq_in < len(starts) or starts[seq_in] > end:
                continue
            axes.annotate(
                "",
                ((starts[seq_in] - begin) / 1e3, rows[1] - 0.28 * down),
                ((sent - begin) / 1e3, rows[0] + 0.28 * down),
                arrowprops={"arrowstyle": "->", "color": MUTED, "lw": 0.8, "shrinkA": 0, "shrinkB": 0},
            )
