"""Figures and numbers on timing: periods, lateness, and the schedule."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sim2real.graph.episode import Episode, Steps
from sim2real.log.session import oldest_input
from sim2real.view import style
from sim2real.view.node_looks import color_of, in_order, slowest_period_s
from sim2real.view.style import BLUE, INK, MUTED, ORANGE, new_figure, styled, to_svg

_PERIODS_SHOWN = 4.5


@dataclass(frozen=True)
class Times:
    """Times of one node's N steps [ms].

    Attributes:
        period: Shape ``(N - 1,)``: from one wake-up to the next.
        lateness: Shape ``(N,)``: from the start by the timing rules to the wake-up.
        computation: Shape ``(N,)``: from the wake-up to the end.
    """

    period: np.ndarray
    lateness: np.ndarray
    computation: np.ndarray


def times(steps: Steps) -> Times:
    """Return the times of a node's steps."""
    return Times(np.diff(steps.woken) / 1e3, (steps.woken - steps.start) / 1e3, (steps.end - steps.woken) / 1e3)


def histograms(episode: Episode, name: str) -> str:
    """Draw histograms of period, lateness, computation and age of inputs, one row per node."""
    nodes = [n for n in in_order(episode) if len(episode.steps[n]) > 1]
    ages = {n: 1e3 * oldest_input(episode, n) for n in nodes}
    oldest = max((float(a.max()) for a in ages.values() if a.size), default=0.0)
    with styled():
        figure = new_figure(0.6 + 1.35 * len(nodes))
        grid = figure.subplots(len(nodes), 4, squeeze=False, sharex="col", sharey="row")
        # Use common limits in each column, so that nodes can be compared.
        limits = []
        for column, quantity in enumerate(("period", "lateness", "computation")):
            values = np.concatenate([getattr(times(episode.steps[n]), quantity) for n in nodes])
            limits.append((min(0.0, values.min()) if column else values.min(), max(values.max(), 1e-3)))
        # Draw a row of histograms for each node.
        for node, row in zip(nodes, grid, strict=True):
            measured = times(episode.steps[node])
            row[0].set_ylabel(f"{node}\nsteps")
            columns = (measured.period, measured.lateness, measured.computation)
            color = color_of(episode, node, BLUE)
            for axes, values, span in zip(row, columns, limits, strict=False):
                _histogram(axes, values, span, color)
            if ages[node].size:
                _histogram(row[3], ages[node], (0.0, max(oldest, 1e-3)), color)
            else:
                row[3].annotate("no inputs", (0.03, 0.8), xycoords="axes fraction", color=MUTED)
        for axes, title in zip(
            grid[0], ("Period", "Lateness of the wake-up", "Computation", "Age of inputs"), strict=True
        ):
            axes.annotate(title, (0, 1.22), xycoords="axes fraction", fontweight="bold", fontsize=9, color=INK)
        for axes in grid[-1]:
            axes.set_xlabel("[ms]")
        what = "period, lateness, computation and age of inputs"
        return to_svg(figure, name, f"Histograms of {what} of {', '.join(nodes)}")


def schedule(episode: Episode, name: str) -> str:
    """Draw when nodes computed and waited, in the middle of the episode and around the latest wake-up."""
    nodes = [n for n in in_order(episode) if len(episode.steps[n])]
    length = _PERIODS_SHOWN * 1e6 * slowest_period_s(episode)
    # Find the latest wake-up, which the right plot shows.
    late = {n: episode.steps[n].woken - episode.steps[n].start for n in nodes}
    worst = max(nodes, key=lambda n: late[n].max())
    moment = int(episode.steps[worst].start[late[worst].argmax()])
    middle = int(1e6 * episode.duration_s / 2)
    with styled():
        figure = new_figure(1.15 + 0.42 * len(nodes))
        titles = (f"At {middle / 1e6:.1f} s", f"Around the latest wake-up: {worst}, {late[worst].max() / 1e3:.1f} ms")
        grid = figure.subplots(1, 2, sharey=True)
        # Draw steps as bars and messages as arrows, in the middle and around the latest wake-up.
        for axes, begin, title in zip(grid, (middle, max(0, moment - int(0.4 * length))), titles, strict=True):
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


def _histogram(axes: Axes, values: np.ndarray, span: tuple[float, float], color: str) -> None:
    axes.hist(values, bins=60, range=span, histtype="stepfilled", facecolor=color, alpha=0.35)
    axes.hist(values, bins=60, range=span, histtype="step", color=color, lw=1.0)
    axes.set_yscale("log")
    axes.set_ylim(0.6, 2 * len(values))
    style.plain_log(axes.yaxis)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    p50, p99 = np.quantile(values, [0.5, 0.99])
    axes.axvline(p99, color=INK, lw=0.9, ls=style.DASHES[1])
    axes.set_title(f"p50 {p50:.2f} · p99 {p99:.2f} · max {values.max():.2f}", fontweight="normal", fontsize=8)


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
