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

        A trainable delay is set to its smallest value, as in a drawn timeline, so that windows hold the messages for
        any delay; the record has the arrivals at the delay during the recording.

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
    """Return the edge with a trainable delay set to its smallest value, as in drawn timelines."""
    if not isinstance(connection.delay_dist, TrainableDist):
        return edge
    steps, reader = episode.steps[connection.input_node.name], vertices[connection.input_node.name]
    reader = Vertex(steps.start[None], reader.end, reader.count)  # the original start, even if the step has moved it
    return at_delay(connection, edge, reader, vertices[edge.sender], to_ticks(connection.delay_dist.min))


def _pad(arrays: Sequence[np.ndarray], value: np.int64) -> np.ndarray:
    """Join arrays ``(E_i, N_i)`` along the episodes, after padding each to the largest width."""
    width = max(a.shape[1] for a in arrays)
    return np.concatenate([np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=value) for a in arrays])
