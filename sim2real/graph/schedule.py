"""Turns delays of a graph into timelines, by the rules of ``rules.py``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, by_name, check_senders, phase_ticks, to_ticks
from sim2real.graph.rules import consumer, next_drift, quota, slot, start, waits_for_schedule
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import NEVER, Edge, Vertex


def draw(
    nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
    duration_s: float,
    episodes: int = 1,
    rng: np.random.Generator | int = 0,
    recorded: Timeline | None = None,
) -> Timeline:
    """Draw timelines: sample all delays, then apply the rules.

    Args:
        nodes: The nodes, by name or as a list.
        duration_s: Steps that start before this time belong to the timeline [s].
        episodes: Number of timelines; without effect if ``recorded`` is given.
        rng: Generator or seed of the delays.
        recorded: Vertices and edges that stay unchanged; only missing ones, e.g. of a simulated world, are drawn.

    Raises:
        UsageError: The graph has an algebraic loop, a node makes no step in the duration or has ``advance`` without a
            blocking input, a sender is not in the graph, or the samples of a distribution are not valid delays.
    """
    nodes = by_name(nodes)
    check_senders(nodes)
    # Refuse lengths that are not finite.
    if not (math.isfinite(duration_s) and episodes >= 1):
        raise UsageError(
            f"{episodes} timelines of {duration_s} s cannot be drawn", hint="draw one or more, of a few seconds"
        )

    # Draw the computation delays of all nodes, then the communication delays of all connections.
    rng = np.random.default_rng(rng)
    fixed = recorded or Timeline({}, {})
    episodes = fixed.episodes if recorded else episodes
    delays = {
        name: _computation_delays(node, duration_s, episodes, rng)
        for name, node in nodes.items()
        if name not in fixed.vertices
    }
    transfers = {}
    for node in nodes.values():
        for c in node.inputs.values():
            if (node.name, c.name) not in fixed.edges:
                sender = fixed.vertices.get(c.output_node.name)
                count = sender.start.shape[1] if sender else delays[c.output_node.name].shape[1]
                transfers[node.name, c.name] = _sampled(c.delay_dist, rng, (episodes, count), repr(c))
    return derive(nodes, delays, transfers, to_ticks(duration_s), fixed)


def derive(
    nodes: Mapping[str, BaseNode],
    delays: Mapping[str, np.ndarray],
    transfers: Mapping[tuple[str, str], np.ndarray],
    duration: int,
    fixed: Timeline | None = None,
) -> Timeline:
    """Apply the rules to given delays.

    Args:
        delays: Node -> computation delays, shape ``(E, N)`` [ticks].
        transfers: (node, input) -> communication delays, shape ``(E, M)`` [ticks].
        duration: Steps that start before this belong to the timeline [ticks].
        fixed: Vertices and edges that stay unchanged.
    """
    # Starts, ends and arrivals of the messages that blocking inputs wait for.
    fixed = fixed or Timeline({}, {})
    vertices = dict(fixed.vertices)
    received: dict[tuple[str, str], np.ndarray] = {}
    _run_in_order(nodes, delays, transfers, vertices, received)
    for name in delays:
        v = vertices[name]
        vertices[name] = Vertex(v.start, v.end, (v.start < duration).sum(axis=1))

    # Arrivals of all messages, and the steps that consume them.
    edges = dict(fixed.edges)
    for key in transfers:
        connection = nodes[key[0]].inputs[key[1]]
        sender = connection.output_node.name
        # For a blocking input `received` has only the messages that steps waited for; here all are needed.
        arrivals = np.maximum.accumulate(vertices[sender].end + transfers[key], axis=1)
        seq_in = consumer(connection, arrivals, vertices[key[0]], vertices[sender])
        edges[key] = Edge(arrivals, seq_in, sender)
    return Timeline(vertices, edges)


def rederive(episode: Episode, nodes: Mapping[str, BaseNode]) -> Timeline:
    """Apply the rules to the delays of a recorded episode.

    The result equals ``Timeline.from_episode(episode, nodes)`` if the recorded run kept the rules. Starts that a step
    has set itself are copied from the record.

    Raises:
        UsageError: The record lacks one of them.
    """
    recorded = Timeline.from_episode(episode, nodes)
    missing = [n for n in nodes if n not in recorded.vertices]
    if missing:
        raise UsageError(f"the record lacks {', '.join(missing)}. Available: {', '.join(recorded.vertices)}")
    delays = {n: v.end - episode.steps[n].start[None] for n, v in recorded.vertices.items()}
    transfers = {k: e.received - recorded.vertices[e.sender].end for k, e in recorded.edges.items()}
    derived = derive(nodes, delays, transfers, int(NEVER))
    moved = {n: episode.steps[n].ts_overwrite[None] for n in nodes}
    vertices = {
        n: Vertex(np.where(moved[n] >= 0, moved[n], v.start), v.end, v.count) for n, v in derived.vertices.items()
    }
    return Timeline(vertices, derived.edges)


def _computation_delays(node: BaseNode, duration_s: float, episodes: int, rng: np.random.Generator) -> np.ndarray:
    """Draw a node's computation delays [ticks], shape ``(E, N)``: one for each slot within the duration."""
    last = to_ticks(duration_s) - 1 - phase_ticks(node)
    count = int(np.floor(last * (node.rate / TICKS_PER_S))) + 2 if last >= 0 else 0
    count = int((slot(node, np.arange(count)) <= last + phase_ticks(node)).sum())
    if count == 0:
        raise UsageError(
            f"node {node.name!r} makes no step within {duration_s} s: its first is due after {node.phase} s",
            hint="draw longer timelines",
        )
    return _sampled(node.delay_dist, rng, (episodes, count), f"node {node.name!r}")


def _sampled(dist: DelayDistribution, rng: np.random.Generator, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Draw delays [ticks] and check them: a user may have written the distribution."""
    seconds = np.asarray(dist.sample(rng, shape))
    if seconds.shape != shape or not np.isfinite(seconds).all() or (seconds < 0).any():
        raise UsageError(
            f"{where}: {dist!r} draws invalid delays: {seconds.ravel()[:3]} of shape {seconds.shape}",
            hint=f"sample() returns finite seconds of at least 0, of the shape of its argument, here {shape}",
        )
    return np.floor(seconds * TICKS_PER_S + 0.5).astype(np.int64)


def _run_in_order(
    nodes: Mapping[str, BaseNode],
    delays: Mapping[str, np.ndarray],
    transfers: Mapping[tuple[str, str], np.ndarray],
    vertices: dict[str, Vertex],
    received: dict[tuple[str, str], np.ndarray],
) -> None:
    """Fill ``vertices`` and ``received`` (rules 3 to 5): nodes without blocking inputs first, others in slot order."""
    # Nodes without blocking inputs run at once, all steps in one array operation.
    linked = []
    for name, busy in delays.items():
        if any(c.blocking for c in nodes[name].inputs.values()):
            linked.append(name)
            waits_for_schedule(nodes[name])
        else:
            vertices[name] = _free_running(nodes[name], busy)
    if not linked:
        return
    # Steps with blocking inputs run one by one, in the order of their schedule; senders come first at equal times.
    rank = {name: i for i, name in enumerate(topological(nodes))}
    steps = [
        (int(s), rank[name], name, k)
        for name in linked
        for k, s in enumerate(slot(nodes[name], np.arange(delays[name].shape[1])))
    ]
    runs = {name: _BlockingRun(nodes[name], delays[name], transfers, vertices, received) for name in linked}
    for _, _, name, k in sorted(steps):
        runs[name].step(k)


def _free_running(node: BaseNode, busy: np.ndarray) -> Vertex:
    """Return the steps of a node without blocking inputs."""
    waits = waits_for_schedule(node)
    slots = slot(node, np.arange(busy.shape[1]))
    if busy.shape[1] < 2 or (busy[:, :-1] <= np.diff(slots)).all():  # no overruns: steps start at their slots
        begin = np.broadcast_to(slots, busy.shape).copy()
        return Vertex(begin, begin + busy, np.full(busy.shape[0], busy.shape[1]))
    begin, end = np.empty_like(busy), np.empty_like(busy)
    drift = previous = np.zeros(busy.shape[0], np.int64)
    for k, scheduled in enumerate(slots):
        begin[:, k] = start(scheduled, drift, previous, 0, waits)
        drift = next_drift(node.scheduling, scheduled, drift, previous)
        previous = end[:, k] = begin[:, k] + busy[:, k]
    return Vertex(begin, end, np.full(busy.shape[0], busy.shape[1]))


class _BlockingRun:
    """The steps of one node with blocking inputs, in order."""

    def __init__(
        self,
        node: BaseNode,
        busy: np.ndarray,
        transfers: Mapping[tuple[str, str], np.ndarray],
        vertices: dict[str, Vertex],
        received: dict[tuple[str, str], np.ndarray],
    ) -> None:
        self.busy = busy
        self.vertex = Vertex(np.zeros_like(busy), np.zeros_like(busy), np.full(busy.shape[0], busy.shape[1]))
        vertices[node.name] = self.vertex
        self.vertices, self.transfers, self.received = vertices, transfers, received
        self.node = node
        self.slots = slot(node, np.arange(busy.shape[1]))
        self.waits = waits_for_schedule(node)
        self.inputs = [(c, quota(c, np.arange(busy.shape[1]))) for c in node.inputs.values() if c.blocking]
        self.done = dict.fromkeys([c.name for c, _ in self.inputs], 0)
        self.drift = self.previous = np.zeros(busy.shape[0], np.int64)

    def step(self, k: int) -> None:
        """Compute start and end of step ``k``, after all steps of earlier slots."""
        blocked = np.zeros_like(self.previous)
        for connection, upto in self.inputs:
            blocked = np.maximum(blocked, self._last_arrival(connection, int(upto[k])))
        begin = start(self.slots[k], self.drift, self.previous, blocked, self.waits)
        self.drift = next_drift(self.node.scheduling, self.slots[k], self.drift, self.previous)
        self.previous = begin + self.busy[:, k]
        self.vertex.start[:, k], self.vertex.end[:, k] = begin, self.previous

    def _last_arrival(self, connection: Connection, upto: int) -> np.ndarray:
        """Return the last arrival [ticks] of messages before ``upto``; 0: none is new; ``NEVER``: one is never sent."""
        key = (self.node.name, connection.name)
        ends = self.vertices[connection.output_node.name].end
        if key not in self.received:
            self.received[key] = np.zeros_like(ends)
        arrivals = self.received[key]
        first = self.done[connection.name]
        if upto > max(first, ends.shape[1]):  # the recorded sender stops before its reader
            return np.full(len(arrivals), NEVER)
        # Messages arrive in order: none before the previous one.
        for m in range(first, upto):
            arrivals[:, m] = ends[:, m] + self.transfers[key][:, m]
            if m:
                np.maximum(arrivals[:, m], arrivals[:, m - 1], out=arrivals[:, m])
        self.done[connection.name] = max(first, upto)
        return arrivals[:, upto - 1] if upto > first else np.zeros(len(arrivals), np.int64)


def topological(nodes: Mapping[str, BaseNode]) -> list[str]:
    """Return the node names in an order in which senders come before readers; skipped connections do not count."""
    order: list[str] = []

    def visit(node: BaseNode) -> None:
        if node.name in order:
            return
        for c in node.inputs.values():
            if not c.skip and c.output_node.name in nodes:
                visit(c.output_node)
        order.append(node.name)

    for node in nodes.values():
        phase_ticks(node)  # raises an error that names the loop, if there is one
        visit(node)
    return order
