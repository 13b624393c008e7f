"""The row and the slot of the compiled program in which each step of a timeline is computed.

The program is a loop over **rows**. A row is one boundary, at which steps of the nodes are computed in a fixed sequence
of **slots**, followed by n world ticks. The world ticks on a fixed grid and always runs. A step may be computed at any
time after the last tick that it depends on and before the first tick that depends on its output. These two are usually
far enough apart that a boundary lies between them, even if boundaries are several ticks apart.

Each slot belongs to one node. The steps of every row must fit into the sequence such that each step comes after the
steps whose messages it consumes, and after its node's previous step. The sequence should be short, because every row
computes every slot, with or without a step in it: this is a shortest common supersequence problem.

Pure numpy, before anything is compiled.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.graph.schedule import topological
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Edge, search_rows
from sim2real.graph.windows import newest_message

MOST_STEPS = 256
"""Largest number of steps of one node in a row."""
_UNREAD = np.int64(2**40)
"""Tick at which an output without a reader is needed: after all others."""

Steps = dict[str, np.ndarray]
"""Node name -> an int64 for each of its steps, shape ``(E, N)``."""


@dataclass(frozen=True)
class Placement:
    """The rows and slots of all steps.

    Attributes:
        ticks: Number of world ticks in a row; 1 without a world.
        row: Row of each step; steps with a row after the last one are not computed.
        slot: Slot of each step in its row.
        slots: Node of each slot, in the order in which slots run.
    """

    ticks: int
    rows: int
    row: Steps
    slot: Steps
    slots: tuple[str, ...]


class Placer:
    """Places the steps of one timeline; see ``place``.

    Args:
        supervisor: The supervisor's name; a row is at most as long as its period.

    Attributes:
        nodes: The nodes of the timeline, senders before readers.
        world: Name of the world that ticks in every row, the fastest one; None without a world.
        others: The nodes whose steps are computed in slots.
        edges: The connections between nodes of the timeline.
        newest: Connection -> the newest message that each step has consumed, shape ``(E, N)``; -1: none.
    """

    def __init__(self, nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline) -> None:
        self.timeline, self.supervisor = timeline, supervisor
        self.nodes = {n: nodes[n] for n in topological(nodes) if n in timeline.vertices}
        worlds = [n for n in self.nodes.values() if isinstance(n, BaseWorld)]
        self.world = max(worlds, key=lambda n: n.rate).name if worlds else None
        self.others = [n for n in self.nodes if n != self.world]
        self.edges = {k: e for k, e in timeline.edges.items() if k[0] in self.nodes and e.sender in self.nodes}
        self.newest = {k: newest_message(e, timeline.vertices[k[0]]) for k, e in self.edges.items()}

    def place(self) -> Placement:
        """Place all steps."""
        if self.world is None:
            row = self._rows_of_supervisor()
            placement = self._fill(1, int(self.timeline.vertices[self.supervisor].count.min()), row)
        else:
            placement = self._cheapest(int(self.timeline.vertices[self.world].count.min()))
        if placement.rows < 1:
            raise UsageError("these timelines are shorter than one row", hint="draw longer timelines")
        return placement

    def steps(self, name: str) -> np.ndarray:
        """Return the numbers of a node's steps, shape ``(E, N)``."""
        shape = self.timeline.vertices[name].start.shape
        return np.broadcast_to(np.arange(shape[1], dtype=np.int64), shape)

    def valid(self, name: str) -> np.ndarray:
        """Return the mask of a node's steps that belong to the episode, shape ``(E, N)``, bool."""
        return self.steps(name) < self.timeline.vertices[name].count[:, None]

    def _live(self) -> Iterator[tuple[str, Edge, np.ndarray]]:
        """Yield (reader, edge, newest) of each connection, ordered by reader."""
        order = list(self.nodes)
        for key in sorted(self.edges, key=lambda k: order.index(k[0])):
            yield key[0], self.edges[key], self.newest[key]

    def _cheapest(self, world_ticks: int) -> Placement:
        """Return the placement with the fewest slots of the supervisor, then the fewest slots per tick.

        Training row by row needs a supervisor with one slot. The longest row is not always the best: three steps in ten
        ticks need two slots in rows of four ticks, and one in rows of three.
        """
        rate = self.nodes[self.world or ""].rate
        longest = min(world_ticks, max(1, int(np.ceil(rate / self.nodes[self.supervisor].rate))))
        lowest = self._earliest()
        highest = self._latest(lowest, 2 * longest)
        placements = []
        for n in range(longest, 0, -1):
            # Each step needs a boundary, a multiple of n ticks, between its earliest and its latest tick.
            if n > 1 and not all((-(-lowest[o] // n) * n <= highest[o])[self.valid(o)].all() for o in self.others):
                continue
            placements.append(self._fill(n, world_ticks // n, self._rows(lowest, highest, n)))
        if not placements:
            raise UsageError("these timelines have no tick of the world", hint="draw longer timelines")
        return min(placements, key=lambda p: (p.slots.count(self.supervisor), len(p.slots) / p.ticks))

    def _fill(self, ticks: int, rows: int, row: Steps) -> Placement:
        """Return the placement for given rows of the steps; steps after the last row need no slot."""
        counted = {n: self.valid(n) & (row[n] < rows) for n in self.others}
        heard = [Heard(n, e.sender, at) for n, e, at in self._live() if self.world not in (n, e.sender)]
        slots, slot = arrange(self.supervisor, rows, {n: row[n] for n in self.others}, counted, heard)
        return Placement(ticks, rows, row, slot, slots)

    def _earliest(self) -> Steps:
        """Return the earliest boundary of each step [ticks]: the number of ticks on which it depends.

        Ticks also act on a step through other nodes.
        """
        earliest = {n: np.zeros_like(self.steps(n)) for n in self.others}
        changed = True
        while changed:  # each pass carries bounds over one more connection; a few passes are enough
            changed = False
            for reader, edge, newest in self._live():
                if reader == self.world:
                    continue
                bound = newest + 1 if edge.sender == self.world else _get_heard(earliest[edge.sender], newest)
                new = np.maximum.accumulate(np.maximum(earliest[reader], bound), axis=1)
                changed |= bool((new != earliest[reader]).any())
                earliest[reader] = new
        return earliest

    def _latest(self, lowest: Steps, slack: int) -> Steps:
        """Return the latest boundary of each step [ticks]: the first tick that depends on its output.

        Steps also act on a tick through other nodes. At most ``slack`` ticks after the step's start: the program must
        keep a step's inputs until the step is computed, and some outputs reach the world late or never.
        """
        # Start from the latest tick at which each step could run.
        ticks = self.timeline.vertices[self.world or ""].start
        latest = {}
        for n in self.others:
            natural = search_rows(ticks, self.timeline.vertices[n].start)
            latest[n] = np.maximum(lowest[n], natural) + slack
        # Move senders before their readers until nothing changes.
        changed = True
        while changed:
            changed = False
            for reader, edge, _ in reversed(list(self._live())):
                if edge.sender == self.world:
                    continue
                at = edge.seq_in
                touched = at if reader == self.world else np.take_along_axis(latest[reader], at.clip(0), 1)
                new = np.minimum(latest[edge.sender], np.where(at >= 0, touched, _UNREAD))
                new = np.minimum.accumulate(new[:, ::-1], axis=1)[:, ::-1]
                changed |= bool((new != latest[edge.sender]).any())
                latest[edge.sender] = new
        return latest

    def _rows(self, lowest: Steps, highest: Steps, n: int) -> Steps:
        """Return the row of each step, for rows of ``n`` ticks: early, and mostly one step of a node."""
        rows = {o: -(-lowest[o] // n) for o in self.others}
        # Raise rows until each step comes after the messages that it consumes.
        changed = True
        while changed:
            changed = False
            for name in self.others:
                row = rows[name]
                for reader, edge, newest in self._live():
                    if reader == name and edge.sender != self.world:
                        row = np.maximum(row, _get_heard(rows[edge.sender], newest))
                step = self.steps(name)
                spread = np.maximum.accumulate(row - step, axis=1) + step
                row = np.maximum(row, np.minimum(spread, highest[name] // n))
                changed |= bool((row != rows[name]).any())
                rows[name] = row
        return rows

    def _rows_of_supervisor(self) -> Steps:
        """Return the row of each step in a graph without a world: each step of the supervisor has one row."""
        starts = self.timeline.vertices[self.supervisor].start
        rows = {n: search_rows(starts, np.ascontiguousarray(self.timeline.vertices[n].start)) for n in self.others}
        rows[self.supervisor] = self.steps(self.supervisor).copy()
        changed = True
        while changed:  # a step must not be in an earlier row than the steps whose messages it consumes
            changed = False
            for reader, edge, newest in self._live():
                if reader == self.supervisor:
                    continue
                new = np.maximum.accumulate(np.maximum(rows[reader], _get_heard(rows[edge.sender], newest)), axis=1)
                changed |= bool((new != rows[reader]).any())
                rows[reader] = new
        return {n: rows[n] for n in self.others}


def _get_heard(of_sender: np.ndarray, newest: np.ndarray) -> np.ndarray:
    """Return for each step of the reader the sender's value at its newest message; 0 without a message.

    ``of_sender`` has a value for each step of the sender.
    """
    return np.where(newest >= 0, np.take_along_axis(of_sender, newest.clip(0), 1), 0)


class Heard(NamedTuple):
    """The newest message that each step of ``reader`` has consumed from ``sender``, shape ``(E, N)``; -1: none."""

    reader: str
    sender: str
    newest: np.ndarray


class _Patterns(NamedTuple):
    """The P distinct patterns of steps in a row; rows with the same pattern are treated together.

    Attributes:
        counts: Shape ``(P, n)``: number of steps of each of the n nodes.
        needs: For each node, shape ``(P, M, n)``: how many steps of each node come before its m-th step in the row.
        of_row: Shape ``(E * R,)``: the pattern of each row.
    """

    counts: np.ndarray
    needs: list[np.ndarray]
    of_row: np.ndarray


def arrange(
    supervisor: str, rows: int, row: Steps, counted: Steps, heard: Sequence[Heard]
) -> tuple[tuple[str, ...], Steps]:
    """Return the node of each slot, and the slot of each step.

    The supervisor gets as many slots as it has steps in its fullest row. A greedy search keeps the number of the other
    nodes' slots small.

    Args:
        row: Row of each step. Ties are decided by the order of the nodes in this dictionary.
        counted: Node -> mask of its computed steps, shape ``(E, N)``, bool.
    """
    names = list(row)
    index = {n: _index_in_row(r) for n, r in row.items()}
    for n in names:
        if int(index[n][counted[n]].max(initial=0)) >= MOST_STEPS:
            raise UsageError(
                f"node {n!r} makes more than {MOST_STEPS} steps while the supervisor {supervisor!r} makes one",
                hint="bring the rates closer together",
            )
    # Merge the patterns of all rows into one sequence of slots.
    patterns = _patterns(names, rows, row, index, counted, heard)
    sequence, slot_of = _merge(patterns, names, names.index(supervisor) if supervisor in names else -1)
    # Give each step the slot of its pattern.
    slots = {}
    for i, n in enumerate(names):
        e, k = np.nonzero(counted[n])
        slots[n] = np.zeros_like(row[n])
        slots[n][e, k] = slot_of[i][patterns.of_row[e * rows + row[n][e, k]], index[n][e, k]]
    return tuple(names[i] for i in sequence), slots


def _index_in_row(row: np.ndarray) -> np.ndarray:
    """Return for each step the number of the same node's steps before it in its row."""
    step = np.broadcast_to(np.arange(row.shape[1], dtype=np.int64), row.shape)
    opens = np.ones(row.shape, bool)
    opens[:, 1:] = row[:, 1:] != row[:, :-1]
    return step - np.maximum.accumulate(np.where(opens, step, 0), axis=1)


def _patterns(
    names: list[str], rows: int, row: Steps, index: Steps, counted: Steps, heard: Sequence[Heard]
) -> _Patterns:
    # Count the steps of each node in each row.
    boundaries = rows * next((len(r) for r in row.values()), 0)
    counts = np.zeros((boundaries, len(names)), np.int16)
    at: dict[str, np.ndarray] = {}
    for i, n in enumerate(names):
        e, _ = np.nonzero(counted[n])
        at[n] = e * rows + row[n][counted[n]]
        counts[:, i] = np.bincount(at[n], minlength=boundaries)
    # For each step, the senders' steps of this row that come before it.
    most = counts.max(axis=0, initial=0)
    needs = [np.zeros((boundaries, int(m), len(names)), np.int16) for m in most]
    for reader, sender, newest in heard:
        i, j = names.index(reader), names.index(sender)
        here = (newest >= 0) & (np.take_along_axis(row[sender], newest.clip(0), 1) == row[reader])
        before = np.where(here, np.take_along_axis(index[sender], newest.clip(0), 1) + 1, 0)[counted[reader]]
        places = (at[reader], index[reader][counted[reader]], j)
        needs[i][places] = np.maximum(needs[i][places], before)
    # Rows with equal numbers share a pattern.
    columns = np.concatenate([counts, *(n.reshape(boundaries, n.shape[1] * len(names)) for n in needs)], axis=1)
    first, of_row = _distinct(columns)
    return _Patterns(counts[first].astype(np.int64), [n[first].astype(np.int64) for n in needs], of_row)


def _distinct(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index of each distinct row, and for each row its distinct row, as ``np.unique(axis=0)`` does.

    The columns are first combined into one integer per row: 0.03 s for 400,000 rows, against 0.8 s for ``axis=0``.
    """
    label, size = np.zeros(len(columns), np.int64), 1
    for column in columns.T[columns.any(axis=0)]:
        span = int(column.max()) + 1
        if size * span >= 2**62:
            labels, label = np.unique(label, return_inverse=True)
            size = len(labels)
        label, size = label * span + column, size * span
    _, first, of_row = np.unique(label, return_index=True, return_inverse=True)
    return first, of_row


def _merge(patterns: _Patterns, names: list[str], supervisor: int) -> tuple[list[int], list[np.ndarray]]:
    """Find one sequence of nodes that contains the steps of every pattern in a valid order (greedy search).

    Slots are added one by one; every pattern with a ready step of that node puts the step there.

    Returns:
        The sequence; and for each node, shape ``(P, M)``, the slots of the steps of each pattern.
    """
    counts, needs = patterns.counts, patterns.needs
    every = np.arange(len(counts))
    placed = np.zeros_like(counts)
    slots = [np.zeros(n.shape[:2], np.int64) for n in needs]
    sequence: list[int] = []
    while (left := counts - placed).any():
        # A step is ready if the steps that it needs are placed.
        ready = np.zeros(counts.shape, bool)
        for i in np.flatnonzero(left.any(axis=0)):
            need = needs[i][every, np.minimum(placed[:, i], needs[i].shape[1] - 1)]
            ready[:, i] = (left[:, i] > 0) & (placed >= need).all(axis=1)

        # Prefer a node whose step is ready in all the patterns that have the most steps of it left: such a slot is
        # needed in any case. Otherwise add a slot for the node whose step is ready in most patterns, never for the
        # # supervisor: its step waits for the step of another node, which then is ready.
        fullest = (left == left.max(axis=0)) & (left > 0)
        shortens = ready.any(axis=0) & ~(fullest & ~ready).any(axis=0)
        if shortens.any():
            waiting = ((left > 0) & ~ready).sum(axis=0)
            i = int(np.argmin(np.where(shortens, waiting, len(counts) + 1)))
        else:
            patterns_ready = ready.sum(axis=0)
            if supervisor >= 0:
                patterns_ready[supervisor] = 0
            i = int(np.argmax(patterns_ready))

        # Place the step in all patterns in which it is ready.
        now = np.flatnonzero(ready[:, i])
        if not len(now):
            stuck = [names[j] for j in np.flatnonzero(left.any(axis=0))]
            raise UsageError(
                f"steps of {', '.join(stuck)} wait for each other's messages of the same instant",
                hint="give the nodes of a loop a computation delay",
            )
        slots[i][now, placed[now, i]] = len(sequence)
        placed[now, i] += 1
        sequence.append(i)
    return sequence, slots
