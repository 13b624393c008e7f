"""Timelines: the times of steps, and the messages that each step consumes, for E episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import Episode, Messages
from sim2real.graph.node import BaseNode, Connection, to_ticks
from sim2real.graph.rules import at_delay
from sim2real.graph.times import NEVER, Edge, Vertex


@dataclass(frozen=True, repr=False)
class Timeline:
    """E episodes of a graph: vertices by node, edges by (node, input name)."""

    vertices: Mapping[str, Vertex]
    edges: Mapping[tuple[str, str], Edge]

    def __repr__(self) -> str:
        steps = ", ".join(f"{n} {int(v.count.max(initial=0))}" for n, v in self.vertices.items())
        return f"Timeline({self.episodes} episodes, steps: {steps})"

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return next((len(v.count) for v in self.vertices.values()), 0)

    def __getitem__(self, index: slice | np.ndarray | Sequence[int]) -> Timeline:
        """Select episodes."""
        return Timeline(
            {n: Vertex(v.start[index], v.end[index], v.count[index]) for n, v in self.vertices.items()},
            {k: Edge(e.received[index], e.seq_in[index], e.sender) for k, e in self.edges.items()},
        )

    @staticmethod
    def from_episode(episode: Episode, nodes: Mapping[str, BaseNode]) -> Timeline:
        """Return the timeline of one recorded episode (E = 1).

        Messages with a trainable delay arrive at its smallest value, as in a drawn timeline: the record has them at the
        delay of that time, and windows need them for any delay.

        Args:
            nodes: The nodes by name; the timeline has those that are in the record, and connections between them.

        Raises:
            UsageError: The record has none of the nodes.
        """
        # Times of the steps.
        vertices, edges = {}, {}
        present = [n for n in nodes if n in episode.steps]
        if not present:
            raise UsageError(f"the record has none of {', '.join(nodes)}. Available: {', '.join(episode.steps)}")
        for name in present:
            steps = episode.steps[name]
            vertices[name] = Vertex(steps.begun[None], steps.end[None], np.array([len(steps)]))
        # Times of the messages, at the smallest delay of a trainable connection.
        for (name, input_name), m in episode.messages.items():
            if name not in vertices or input_name not in nodes[name].inputs:
                continue
            sender = nodes[name].inputs[input_name].output_node.name
            if sender in vertices:
                edge = _edge(m, len(episode.steps[sender]), len(episode.steps[name]), sender)
                edges[name, input_name] = _at_smallest_delay(nodes[name].inputs[input_name], edge, episode, vertices)
        return Timeline(vertices, edges)

    @staticmethod
    def stack(timelines: Sequence[Timeline]) -> Timeline:
        """Return one timeline with the episodes of several timelines of the same graph; shorter ones are padded."""
        if not timelines:
            raise UsageError("no timelines to stack")
        first = timelines[0]
        for t in timelines[1:]:
            if set(t.vertices) != set(first.vertices) or set(t.edges) != set(first.edges):
                raise UsageError("only timelines of the same nodes and connections can be stacked")
        # Pad steps and messages to the longest timeline.
        vertices = {
            n: Vertex(
                _pad([t.vertices[n].start for t in timelines], NEVER),
                _pad([t.vertices[n].end for t in timelines], NEVER),
                np.concatenate([t.vertices[n].count for t in timelines]),
            )
            for n in first.vertices
        }
        edges = {
            k: Edge(
                _pad([t.edges[k].received for t in timelines], NEVER),
                _pad([t.edges[k].seq_in for t in timelines], np.int64(-1)),
                first.edges[k].sender,
            )
            for k in first.edges
        }
        return Timeline(vertices, edges)

    def cut(
        self, begins: Sequence[int], length: int, lead: Mapping[str, int] | None = None
    ) -> tuple[Timeline, dict[str, np.ndarray]]:
        """Cut one episode into segments; in each, time starts at 0.

        Args:
            begins: Starts of the segments [ticks].
            length: Length of every segment [ticks].
            lead: Node -> time before the segment's start from which its steps are kept, at negative times [ticks].

        Returns:
            The segments as E episodes; and for each node, shape ``(E,)``, the number of the original step that is step
            0 of each segment.

        Raises:
            UsageError: The timeline has more than one episode.
        """
        if self.episodes != 1:
            raise UsageError(f"only a timeline of one episode can be cut, this one has {self.episodes}")
        ahead = lead or {}
        firsts = {
            n: np.searchsorted(v.start[0, : v.count[0]], np.asarray(begins) - ahead.get(n, 0))
            for n, v in self.vertices.items()
        }
        parts = [self._part({n: int(f[i]) for n, f in firsts.items()}, b, length) for i, b in enumerate(begins)]
        return Timeline.stack(parts), firsts

    def _part(self, firsts: Mapping[str, int], begin: int, length: int) -> Timeline:
        """Return one segment; ``firsts`` has the first step of each node that belongs to it."""
        vertices, edges = {}, {}
        last: dict[str, int] = {}
        for n, v in self.vertices.items():
            stop = int(np.searchsorted(v.start[0, : v.count[0]], begin + length))
            last[n] = stop
            take = slice(firsts[n], stop)
            count = np.array([stop - firsts[n]])
            vertices[n] = Vertex(v.start[:, take] - begin, v.end[:, take] - begin, count)
        for (n, i), e in self.edges.items():
            take = slice(firsts[e.sender], last[e.sender])
            seq_in = e.seq_in[:, take]
            # A message that was consumed before the segment's first step is in the window of that step.
            inside = (seq_in >= 0) & (seq_in < last[n])
            seq_in = np.where(inside, np.maximum(seq_in - firsts[n], 0), -1)
            edges[n, i] = Edge(e.received[:, take] - begin, seq_in, e.sender)
        return Timeline(vertices, edges)


def _edge(messages: Messages, sent: int, steps: int, sender: str) -> Edge:
    """Return an edge (E = 1) with one entry for each of the ``sent`` messages; a damaged record may lack some."""
    received, seq_in = np.full(sent, NEVER), np.full(sent, -1, np.int64)
    valid = messages.seq_out < sent
    received[messages.seq_out[valid]] = messages.received[valid]
    seq_in[messages.seq_out[valid]] = messages.seq_in[valid]
    # Messages are consumed in order: after one that is lost, or that no recorded step consumed, all count as lost.
    lost = np.logical_or.accumulate((seq_in < 0) | (seq_in >= steps))
    return Edge(received[None], np.where(lost, -1, seq_in)[None], sender)


def _at_smallest_delay(connection: Connection, edge: Edge, episode: Episode, vertices: Mapping[str, Vertex]) -> Edge:
    """Return an edge as drawn timelines have it: at the smallest value of a trainable delay."""
    if not isinstance(connection.delay_dist, TrainableDist):
        return edge
    steps, reader = episode.steps[connection.input_node.name], vertices[connection.input_node.name]
    reader = Vertex(steps.start[None], reader.end, reader.count)  # not where a step has moved its start to
    return at_delay(connection, edge, reader, vertices[edge.sender], to_ticks(connection.delay_dist.min))


def _pad(arrays: Sequence[np.ndarray], value: np.int64) -> np.ndarray:
    """Join arrays ``(E_i, N_i)`` along the episodes, after padding each to the largest width."""
    width = max(a.shape[1] for a in arrays)
    return np.concatenate([np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=value) for a in arrays])
