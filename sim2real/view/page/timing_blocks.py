"""Tiles, figures and the table of a page about the timing of episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple

import numpy as np

from sim2real.artifacts.timing import Timing
from sim2real.graph.episode import Episode
from sim2real.log.session import is_imported, oldest_input
from sim2real.types import Json
from sim2real.view import timing
from sim2real.view.blocks import MISSING, Block, FigureBlock, TableBlock, Tile, fixed, number


def timing_tiles(episodes: Sequence[Episode]) -> Iterator[Tile]:
    """Yield the worst lateness, the oldest input and the overruns of some episodes; nothing of an imported log."""
    if any(map(is_imported, episodes)):
        return
    late = {n: np.concatenate([timing.times(e.steps[n]).lateness for e in episodes]) for n in episodes[0].steps}
    p99 = {n: float(np.quantile(values, 0.99)) for n, values in late.items() if len(values)}
    worst = max(p99, key=lambda n: p99[n])
    yield Tile("lateness, p99", f"{p99[worst]:.2f} ms", f"of {worst}, the worst node")
    # Lateness does not show old messages, so show the oldest input, too.
    old = {n: np.concatenate([oldest_input(e, n) for e in episodes]) for n in episodes[0].steps}
    oldest = {n: 1e3 * float(ages.max()) for n, ages in old.items() if ages.size}
    if oldest:
        reader = max(oldest, key=lambda n: oldest[n])
        yield Tile("oldest input of a step", f"{oldest[reader]:.1f} ms", f"of {reader}")
    ends: list[Mapping[str, Json]] = [e.metadata.get("log", {}).get("session_end") or {} for e in episodes]
    overruns = [t.get("overruns", 0) for end in ends for t in end.get("timing", {}).values()]
    if overruns:
        lost = ends[-1].get("lost_replies")  # the count covers all episodes of a session
        yield Tile("overruns", str(sum(overruns)), f"{lost} lost replies" if lost is not None else "")


def timing_blocks(episode: Episode, name: str, which: str = "", folded: bool = False) -> list[Block]:
    """Return figures and table about an episode's timing; nothing of an imported log, whose steps have stamps alone."""
    if is_imported(episode):
        return []
    end: Mapping[str, Json] = episode.metadata.get("log", {}).get("session_end") or {}
    rows, measured = [], Timing.of(episode)
    # Make a row for each node: quantiles of period, lateness, computation, bus and age.
    for node in timing.in_order(episode):
        steps = episode.steps[node]
        if len(steps) < 2:
            continue
        row = [node, str(len(steps))]
        taken = timing.times(steps)
        for values in (taken.period, taken.lateness, taken.computation):
            p50, p99 = np.quantile(values, [0.5, 0.99])
            row += [fixed(float(v), 2) for v in (p50, p99, values.max())]
        row += [MISSING if t is None else fixed(1e3 * t, 2) for t in astuple(measured.nodes[node].bus)]
        ages = 1e3 * oldest_input(episode, node)
        row += [fixed(float(q), 2) for q in np.quantile(ages, [0.5, 0.99, 1.0])] if ages.size else [MISSING] * 3
        rows.append([*row, number(end.get("timing", {}).get(node, {}).get("overruns"))])
    heads = [f"{q} {k}" for q in ("period", "late", "comp.", "bus", "age") for k in ("p50", "p99", "max")]
    table = TableBlock(
        f"Timing of each node [ms]{which and ',' + which.lower().rstrip('.')}",
        ("node", "steps", *heads, "overruns"),
        rows,
        folded=folded,
    )
    # Draw figures only for the first episode.
    if folded or not rows:
        return [table]
    return [
        FigureBlock(
            timing.schedule(episode, f"{name}-schedule"),
            f"Computation of each node over time.{which} An arrow is a message, from the end of the sender's step to "
            "the start of the reader's step.",
        ),
        FigureBlock(
            timing.histograms(episode, f"{name}-timing"),
            f"Times of the nodes, in ms.{which} Age: time from the sending of a message to the step that uses it, for "
            "the oldest input. Dashed: the 99 % quantile. Counts are logarithmic.",
        ),
        table,
    ]
