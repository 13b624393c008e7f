"""The messages in a reader's window, computed from a timeline."""

from collections.abc import Mapping

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, to_ticks
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import NEVER, Edge, Vertex, search_rows

EMPTY_AGE_S = 1e6
"""Age of an empty slot in a window [s]: older than any message."""
_ROUNDING = 2
"""Slots are rounded to whole ticks, so two slots can be closer than the period by this [ticks]."""


def newest_message(edge: Edge, reader: Vertex) -> np.ndarray:
    """Return the newest message that the reader has consumed by each step, shape ``(E, N)``; -1 before the first."""
    steps = np.broadcast_to(np.arange(reader.start.shape[1], dtype=np.int64), reader.start.shape)
    return search_rows(np.where(edge.seq_in < 0, NEVER, edge.seq_in), steps, "right") - 1


def longest_burst(edge: Edge, reader: Vertex) -> int:
    """Return the largest number of messages that one step consumes; the first step does not count."""
    newest = np.where(np.arange(reader.start.shape[1]) < reader.count[:, None], newest_message(edge, reader), -1)
    return int(np.diff(newest, axis=1).max(initial=0))


def overfull(
    connection: Connection, edge: Edge, reader: Vertex, sender: Vertex, delay_s: float | None = None
) -> np.ndarray:
    """Return the steps at which a trainable delay may need messages that are no longer in the window.

    The window is long enough for a sender that keeps its rate. In a burst, the same number of messages spans less time,
    so that at the largest delay the message that a step should read has left the window.

    Args:
        delay_s: The delay, where it does not change while the graph runs [s]; default: the largest one.

    Returns:
        Shape ``(E, N)``, bool; False without a trainable delay.
    """
    dist = connection.delay_dist
    if not isinstance(dist, TrainableDist):
        return np.zeros(reader.start.shape, bool)
    # The message that the step reads at the largest delay (for a mean: the one that holds at the period's start).
    oldest = newest_message(edge, reader) - (connection.total_window - connection.window)
    if not (edge.seq_in.shape[1] and reader.start.shape[1]):
        return np.zeros(reader.start.shape, bool)
    sent = np.take_along_axis(sender.end, oldest.clip(0), axis=1)
    young = reader.start - sent < to_ticks(dist.max if delay_s is None else delay_s) - _ROUNDING
    return young & (oldest >= 0) & (np.arange(reader.start.shape[1]) < reader.count[:, None])


def bursty_episodes(nodes: Mapping[str, BaseNode], timeline: Timeline) -> np.ndarray:
    """Return the mask of episodes with a burst that is too long for the window of a trainable delay, ``(E,)``, bool."""
    bursty = np.zeros(timeline.episodes, bool)
    for (name, input_name), edge in timeline.edges.items():
        connection = nodes[name].inputs[input_name]
        bursty |= overfull(connection, edge, timeline.vertices[name], timeline.vertices[edge.sender]).any(axis=1)
    return bursty


def check_bursts(
    nodes: Mapping[str, BaseNode], timeline: Timeline, delays: Mapping[str, Mapping[str, TrainableDist]] | None = None
) -> None:
    """Check that every window is long enough for its trainable delay, anywhere within its bounds or as in ``delays``.

    Args:
        delays: Node -> input -> the delay, if it does not change while the graph runs.
    """
    for (name, input_name), edge in timeline.edges.items():
        if name not in nodes or input_name not in nodes[name].inputs:
            continue
        connection, reader = nodes[name].inputs[input_name], timeline.vertices[name]
        # Steps whose window would have lost a message.
        given = (delays or {}).get(name, {}).get(input_name)
        delay_s = None if given is None else round(float(given.delay), 6)
        places = np.argwhere(overfull(connection, edge, reader, timeline.vertices[edge.sender], delay_s))
        if len(places) and isinstance(connection.delay_dist, TrainableDist):
            episode, step = places[0]
            raise UsageError(
                f"input {input_name!r} of node {name!r}: messages of {edge.sender!r} come in bursts that its window of "
                f"{connection.total_window} does not hold: at {reader.start[episode, step] / TICKS_PER_S:.3f} s of "
                f"episode {episode} a delay of {connection.delay_dist.max if delay_s is None else delay_s:g} s would "
                f"need a message that has left it ({len(places)} such steps)",
                hint="drop these episodes (sim2real.graph.windows.bursty_episodes finds them), or lengthen the "
                "window: TrainableDist.create(..., burst=2)",
            )


def make_room(nodes: Mapping[str, BaseNode], timeline: Timeline) -> dict[tuple[str, str], int]:
    """Lengthen, in place, the windows of trainable delays that are too short for the bursts of a timeline.

    Otherwise ``check_bursts`` refuses such a timeline.

    Returns:
        (node, input) -> number of messages that were added to the window, for the windows that were too short.
    """
    grown: dict[tuple[str, str], int] = {}
    for key, edge in timeline.edges.items():
        connection = nodes[key[0]].inputs[key[1]]
        reader, sender = timeline.vertices[key[0]], timeline.vertices[edge.sender]
        while isinstance(dist := connection.delay_dist, TrainableDist) and np.any(
            overfull(connection, edge, reader, sender)
        ):
            connection.delay_dist = dist.replace(burst=dist.burst + 1)
            grown[key] = grown.get(key, 0) + 1
    return grown
