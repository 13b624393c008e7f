"""The timing rules of a graph: when a step starts, and which step consumes a message.

Times are computed and compared in integer ticks (1 us), because ties are the normal case: when all delays are as
expected, a message arrives exactly when its reader starts. The wall-clock runtime calls the same functions step by step
with measured times; ``schedule`` calls them for all episodes at once. ``docs/timing.md`` states the numbered rules and
draws them.
"""

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, Jitter, Scheduling, phase_ticks, to_ticks
from sim2real.graph.times import NEVER, Edge, Vertex, search_rows


def slot(node: BaseNode, k: np.ndarray | int, phase: int | None = None) -> np.ndarray:
    """Return when step ``k`` is scheduled [ticks] (rule 2): ``floor(k * 1e6 / rate + 0.5) + phase``.

    Args:
        k: Number of the step, from 0; or an array of them.
        phase: The node's phase [ticks]; None: computed.
    """
    offset = phase_ticks(node) if phase is None else phase
    # Multiply before dividing: exact halves stay exact and are rounded up.
    return np.floor(np.asarray(k) * TICKS_PER_S / node.rate + 0.5).astype(np.int64) + offset


def waits_for_schedule(node: BaseNode) -> bool:
    """Return whether steps wait for their slot (rule 3): unless ``advance`` is set and all inputs block."""
    if not node.advance:
        return True
    if not any(c.blocking for c in node.inputs.values()):
        raise UsageError(
            f"node {node.name!r}: advance=True needs a blocking input, which holds the node back",
            hint="connect an input with blocking=True, or use advance=False",
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
    free = _later(previous_end, blocked_until)
    return _later(scheduled + drift, free) if waits else free


def next_drift(scheduling: Scheduling, scheduled, drift, previous_end):  # noqa: ANN001, ANN201
    """Return the shift of the schedule after a step's start [ticks] (rule 3).

    Args:
        scheduled: The step's slot [ticks].
        drift: The shift before [ticks].
        previous_end: End of the node's previous step [ticks].
    """
    if scheduling is Scheduling.PHASE:
        return drift * 0
    return drift + _later(0, previous_end - scheduled - drift)


def _later(a, b):  # noqa: ANN001, ANN202
    """Return the larger of two. For ints without numpy, which would take 4 % of a control process's time."""
    return max(a, b) if isinstance(a, int) and isinstance(b, int) else np.maximum(a, b)


def eligible(connection: Connection, received: np.ndarray, first_seq: int = 0) -> np.ndarray:
    """Return the earliest reader start [ticks] that consumes each message of a non-blocking input (rule 6).

    Args:
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


def at_delay(connection: Connection, edge: Edge, reader: Vertex, sender: Vertex, delay: int) -> Edge:
    """Return an edge with a trainable delay at another delay [ticks]; lost messages stay lost."""
    sent = sender.end[:, : edge.received.shape[1]]
    received = np.where(edge.received >= NEVER, NEVER, np.maximum.accumulate(sent + delay, axis=1))
    return Edge(received, consumer(connection, received, reader, sender), edge.sender)


def consumer(connection: Connection, received: np.ndarray, reader: Vertex, sender: Vertex) -> np.ndarray:
    """Return which step consumes each message (rule 6).

    Args:
        received: Shape ``(E, M)``: arrivals [ticks].

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
