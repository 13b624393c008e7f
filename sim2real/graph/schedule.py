"""The timing rules of a graph, in one place: delays in, timelines out.

Times are computed and compared in integer ticks (1 us), because ties are the normal case: when all delays are as
expected, a message arrives exactly when its reader starts. The wall-clock runtime calls the same functions step by step
with measured times; here they act on all episodes at once. ``docs/timing.md`` states the numbered rules and draws them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.collection import by_name, check_senders
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, Jitter, Scheduling, phase_ticks, to_ticks
from sim2real.graph.timeline import NEVER, Edge, Timeline, Vertex, search_rows


def slot(node: BaseNode, k: np.ndarray | int, phase: int | None = None) -> np.ndarray:
    """Return when step ``k`` is scheduled [ticks] (rule 2): ``floor(k * 1e6 / rate + 0.5) + phase``.

    Args:
        node: The node.
        k: Number of the step, from 0; or an array of them.
        phase: The node's phase [ticks]; None: computed.
    """
    offset = phase_ticks(node) if phase is None else phase
    # Multiply before dividing: exact halves stay exact and are rounded up.
    return np.floor(np.asarray(k) * TICKS_PER_S / node.rate + 0.5).astype(np.int64) + offset


def waits_for_schedule(node: BaseNode) -> bool:
    """Return whether steps wait for their slot (rule 3): unless ``advance`` is set and all inputs block.

    Raises:
        UsageError: When ``advance`` is set and no input blocks.
    """
    if not node.advance:
        return True
    if not any(c.blocking for c in node.inputs.values()):
        raise UsageError(
            f"node {node.name!r}: advance=True needs a blocking input: nothing else would hold the node back",
            hint="connect an input with blocking=True, or leave advance False",
        )
    return not all(c.blocking for c in node.inputs.values())


def start(scheduled, drift, previous_end, blocked_until, waits: bool):  # noqa: ANN001, ANN201
    """Return a step's start [ticks] (rule 3); times are ints, or int64 arrays of one shape.

    Args:
        scheduled: The step's slot [ticks].
        drift: How far the schedule has moved [ticks].
        previous_end: End of the node's previous step [ticks].
        blocked_until: Last arrival among the messages that the step waits for; 0 without any [ticks].
        waits: Whether the step waits for its slot; see ``waits_for_schedule``.
    """
    free = np.maximum(previous_end, blocked_until)
    return np.maximum(scheduled + drift, free) if waits else free


def next_drift(scheduling: Scheduling, scheduled, drift, previous_end):  # noqa: ANN001, ANN201
    """Return how far the schedule has moved once a step's start is known [ticks] (rule 3).

    Args:
        scheduling: What an overrun does to the later steps.
        scheduled: The step's slot [ticks].
        drift: How far the schedule had moved before [ticks].
        previous_end: End of the node's previous step [ticks].
    """
    if scheduling is Scheduling.PHASE:
        return drift * 0
    return drift + np.maximum(0, previous_end - scheduled - drift)


def eligible(connection: Connection, received: np.ndarray, first_seq: int = 0) -> np.ndarray:
    """Return the earliest reader start [ticks] that consumes each message of a non-blocking input (rule 6).

    Args:
        connection: The connection.
        received: Shape ``(..., M)``: arrivals [ticks].
        first_seq: Sequence number of the first message along the last axis.
    """
    received = np.asarray(received, np.int64)
    if connection.averaged:
        # A tick averages over the commands that arrive before its output is sent; none of them can depend on it.
        return received - to_ticks(connection.input_node.delay) + 1
    earliest = received + 1 if connection.skip else received
    if connection.jitter is Jitter.BUFFER:
        seq = first_seq + np.arange(received.shape[-1])
        earliest = np.maximum(earliest, slot(connection.output_node, seq, 0) + connection.phase_ticks)
    return np.maximum.accumulate(earliest, axis=-1)  # messages are consumed in order


def quota(connection: Connection, k: np.ndarray | int) -> np.ndarray:
    """Return how many messages a blocking input has waited for, in total, when step ``k`` starts (rule 6).

    These are the messages whose sender's slot is not later than the slot of step ``k``; with ``skip``, earlier than it.
    """
    limit = slot(connection.input_node, k)
    if connection.skip:
        limit = limit - 1
    sender = connection.output_node
    ahead = limit - phase_ticks(sender)
    # The inverse of slot(), up to rounding: compare the neighbours of the guess exactly.
    guess = np.floor(ahead * (sender.rate / TICKS_PER_S)).astype(np.int64)
    candidates = guess[..., None] + np.arange(-1, 3)
    fits = (candidates >= 0) & (slot(sender, candidates, 0) <= ahead[..., None])
    return np.where(fits, candidates + 1, 0).max(axis=-1)


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
        episodes: How many timelines; ignored with ``recorded``.
        rng: Generator or seed of the delays.
        recorded: Vertices and edges that are kept as they are; only those that are missing, e.g. of a simulated world,
            are drawn.

    Raises:
        UsageError: On an algebraic loop, a duration in which a node makes no step, ``advance`` without a blocking
            input, a sender that is not in the graph, or a distribution whose samples are not valid delays.
    """
    nodes = by_name(nodes)
    check_senders(nodes)
    if not (math.isfinite(duration_s) and episodes >= 1):
        raise UsageError(
            f"{episodes} timelines of {duration_s} s cannot be drawn", hint="draw one or more, of a few seconds"
        )
    rng = np.random.default_rng(rng)
    kept = recorded or Timeline({}, {})
    episodes = kept.episodes if recorded else episodes
    delays = {
        name: _delays(node, duration_s, episodes, rng) for name, node in nodes.items() if name not in kept.vertices
    }
    transfers = {}
    for node in nodes.values():
        for c in node.inputs.values():
            if (node.name, c.name) not in kept.edges:
                sender = kept.vertices.get(c.output_node.name)
                count = sender.start.shape[1] if sender else delays[c.output_node.name].shape[1]
                transfers[node.name, c.name] = _sampled(c.delay_dist, rng, (episodes, count), repr(c))
    return derive(nodes, delays, transfers, to_ticks(duration_s), kept)


def derive(
    nodes: Mapping[str, BaseNode],
    delays: Mapping[str, np.ndarray],
    transfers: Mapping[tuple[str, str], np.ndarray],
    duration: int,
    kept: Timeline | None = None,
) -> Timeline:
    """Apply the rules to given delays.

    Args:
        nodes: The nodes by name.
        delays: Node -> computation delays, shape ``(E, N)`` [ticks].
        transfers: (node, input) -> communication delays, shape ``(E, M)`` [ticks].
        duration: Steps that start before this belong to the timeline [ticks].
        kept: Vertices and edges that are taken as they are, not derived.
    """
    kept = kept or Timeline({}, {})
    vertices = dict(kept.vertices)
    received: dict[tuple[str, str], np.ndarray] = {}
    _run_in_order(nodes, delays, transfers, vertices, received)
    for name in delays:
        v = vertices[name]
        vertices[name] = Vertex(v.start, v.end, (v.start < duration).sum(axis=1))
    edges = dict(kept.edges)
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

    Args:
        episode: A record of all of ``nodes``.
        nodes: The nodes that ran, by name.

    Raises:
        UsageError: When the record lacks one of them.
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


def at_delay(connection: Connection, edge: Edge, reader: Vertex, sender: Vertex, delay: int) -> Edge:
    """Return an edge whose delay is trainable as it is at another delay; what is lost stays lost.

    Args:
        connection: Whose messages they are.
        edge: The edge at any delay.
        reader: When the reader's steps run.
        sender: When the sender's steps end.
        delay: The delay [ticks].
    """
    sent = sender.end[:, : edge.received.shape[1]]
    received = np.where(edge.received >= NEVER, NEVER, np.maximum.accumulate(sent + delay, axis=1))
    return Edge(received, consumer(connection, received, reader, sender), edge.sender)


def consumer(connection: Connection, received: np.ndarray, reader: Vertex, sender: Vertex) -> np.ndarray:
    """Return which step consumes each message (rule 6).

    Args:
        connection: The connection.
        received: Shape ``(E, M)``: arrivals [ticks].
        reader: The reader's steps.
        sender: The sender's steps.

    Returns:
        Shape ``(E, M)``, int64: the reader's step; -1 where no step consumes the message.
    """
    count = received.shape[1]
    if connection.blocking:
        upto = quota(connection, np.arange(reader.start.shape[1]))
        seq_in = np.broadcast_to(np.searchsorted(upto, np.arange(count), side="right"), received.shape)
    else:
        seq_in = search_rows(reader.start, eligible(connection, received))
    exists = (np.arange(count) < sender.count[:, None]) & (seq_in < reader.count[:, None])
    return np.where(exists, seq_in, -1).astype(np.int64)


def _delays(node: BaseNode, duration_s: float, episodes: int, rng: np.random.Generator) -> np.ndarray:
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
    """Draw delays [ticks] and check them, as the distribution may be a user's own class."""
    seconds = np.asarray(dist.sample(rng, shape))
    if seconds.shape != shape or not np.isfinite(seconds).all() or (seconds < 0).any():
        raise UsageError(
            f"{where}: {dist!r} draws what are no delays: {seconds.ravel()[:3]} of shape {seconds.shape}",
            hint=f"sample() returns finite seconds of at least 0, of the shape that is asked for, here {shape}",
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
    linked = []
    for name, busy in delays.items():
        if any(c.blocking for c in nodes[name].inputs.values()):
            linked.append(name)
            waits_for_schedule(nodes[name])
        else:
            vertices[name] = _free_running(nodes[name], busy)
    if not linked:
        return
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
        """Compute start and end of step ``k``, once all steps of earlier slots are known."""
        blocked = np.zeros_like(self.previous)
        for connection, upto in self.inputs:
            blocked = np.maximum(blocked, self._last_arrival(connection, int(upto[k])))
        begin = start(self.slots[k], self.drift, self.previous, blocked, self.waits)
        self.drift = next_drift(self.node.scheduling, self.slots[k], self.drift, self.previous)
        self.previous = begin + self.busy[:, k]
        self.vertex.start[:, k], self.vertex.end[:, k] = begin, self.previous

    def _last_arrival(self, connection: Connection, upto: int) -> np.ndarray:
        """Return the last arrival [ticks] of messages before ``upto``; 0: no new ones; ``NEVER``: fewer are sent."""
        key = (self.node.name, connection.name)
        ends = self.vertices[connection.output_node.name].end
        if key not in self.received:
            self.received[key] = np.zeros_like(ends)
        arrivals = self.received[key]
        first = self.done[connection.name]
        if upto > max(first, ends.shape[1]):  # a recorded sender that stops before its reader
            return np.full(len(arrivals), NEVER)
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
