"""The row and the slot of the compiled program in which each step of a timeline is computed.

The program is a loop over **rows**. A row is one boundary, at which steps of the nodes are computed in a fixed sequence
of **slots**, followed by n world ticks. The world ticks on a fixed grid and always runs. A step may be computed at any
time after the last tick that it depends on and before the first tick that depends on its output, so there is usually a
boundary in between, also if boundaries are several ticks apart. Pure numpy, before anything is compiled.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.graph.schedule import topological
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Edge, search_rows
from sim2real.graph.windows import newest_message
from sim2real.runtime.compilation.slots import Heard, Steps, arrange

_UNREAD = np.int64(2**40)
"""Tick at which an output without a reader is needed: later than any."""


@dataclass(frozen=True)
class Placement:
    """The rows and slots of all steps.

    Attributes:
        ticks: Number of world ticks in a row; 1 without a world.
        row: Row of each step; steps with a row after the last one are not computed.
        slot: Slot of each step in its row.
        slots: Node of each slot, in the order in which slots run.
        offsets: Number of the row's ticks before each slot: 0, except in a pattern (``pattern.py``).
        last: Number of ticks in the last row.
    """

    ticks: int
    rows: int
    row: Steps
    slot: Steps
    slots: tuple[str, ...]
    offsets: tuple[int, ...]
    last: int


class Placer:
    """Places the steps of one timeline; see ``place``.

    Args:
        supervisor: The supervisor's name; a row is at most as long as its period.
        replayed: Nodes with recorded outputs, which are not computed.

    Attributes:
        nodes: The nodes of the timeline, senders before readers.
        world: Name of the world that ticks in every row, the fastest one; None without a world.
        others: The nodes whose steps are computed in slots.
        edges: The connections between nodes of the timeline.
        newest: Connection -> the newest message that each step has consumed, shape ``(E, N)``; -1: none.
    """

    def __init__(
        self, nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline, replayed: frozenset[str]
    ) -> None:
        self.timeline, self.supervisor, self.replayed = timeline, supervisor, replayed
        self.nodes = {n: nodes[n] for n in topological(nodes) if n in timeline.vertices}
        worlds = [n for n in self.nodes.values() if isinstance(n, BaseWorld) and n.name not in replayed]
        self.world = max(worlds, key=lambda n: n.rate).name if worlds else None
        self.others = [n for n in self.nodes if n != self.world and n not in replayed]
        self.edges = {k: e for k, e in timeline.edges.items() if k[0] in self.nodes and e.sender in self.nodes}
        self.newest = {k: newest_message(e, timeline.vertices[k[0]]) for k, e in self.edges.items()}

    def place(self) -> Placement:
        """Place all steps."""
        if self.world is None:
            row = self._rows_of_supervisor()
            placement = self.fill(1, int(self.timeline.vertices[self.supervisor].count.min()), row)
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

    def live(self) -> Iterator[tuple[str, Edge, np.ndarray]]:
        """Yield (reader, edge, newest) of each connection between nodes that are computed, ordered by reader."""
        order = list(self.nodes)
        keys = [k for k, e in self.edges.items() if e.sender not in self.replayed and k[0] not in self.replayed]
        for key in sorted(keys, key=lambda k: order.index(k[0])):
            yield key[0], self.edges[key], self.newest[key]

    def _cheapest(self, world_ticks: int) -> Placement:
        """Return the placement with the fewest slots for the supervisor; among those, the fewest slots per tick.

        Training row by row needs a supervisor with one slot. The longest row is not always the best: three steps in ten
        ticks need two slots in rows of four ticks, and one in rows of three.
        """
        rate = self.nodes[self.world or ""].rate
        longest = min(world_ticks, max(1, int(np.ceil(rate / self.nodes[self.supervisor].rate))))
        lowest, highest = self.slack(2 * longest)
        placements = []
        for n in range(longest, 0, -1):
            # Every slack interval must contain a boundary, a multiple of n.
            if n > 1 and not all((-(-lowest[o] // n) * n <= highest[o])[self.valid(o)].all() for o in self.others):
                continue
            placements.append(self.fill(n, world_ticks // n, self._rows(lowest, highest, n)))
        if not placements:
            raise UsageError("these timelines have no tick of the world", hint="draw longer timelines")
        return min(placements, key=lambda p: (p.slots.count(self.supervisor), len(p.slots) / p.ticks))

    def slack(self, max_ticks: int) -> tuple[Steps, Steps]:
        """Return the earliest and the latest tick before which each step can be computed.

        Args:
            max_ticks: Largest number of ticks from a step's start to the latest.
        """
        lowest = self._earliest()
        return lowest, self._latest(lowest, max_ticks)

    def fill(self, ticks: int, rows: int, row: Steps) -> Placement:
        """Return the placement for given rows of the steps; steps after the last row need no slot."""
        counted = {n: self.valid(n) & (row[n] < rows) for n in self.others}
        heard = [Heard(n, e.sender, at) for n, e, at in self.live() if self.world not in (n, e.sender)]
        slots, slot = arrange(self.supervisor, rows, {n: row[n] for n in self.others}, counted, heard)
        return Placement(ticks, rows, row, slot, slots, (0,) * len(slots), ticks)

    def _earliest(self) -> Steps:
        """Return the earliest boundary for each step, in ticks: the number of ticks that it depends on.

        Through other nodes' messages as well as directly.
        """
        earliest = {n: np.zeros_like(self.steps(n)) for n in self.others}
        changed = True
        while changed:  # each pass carries bounds over one more connection; a few passes are enough
            changed = False
            for reader, edge, newest in self.live():
                if reader == self.world:
                    continue
                bound = newest + 1 if edge.sender == self.world else get_heard(earliest[edge.sender], newest)
                new = np.maximum.accumulate(np.maximum(earliest[reader], bound), axis=1)
                changed |= bool((new != earliest[reader]).any())
                earliest[reader] = new
        return earliest

    def _latest(self, lowest: Steps, slack: int) -> Steps:
        """Return the latest boundary for each step, in ticks: the first tick that depends on its output.

        Through other nodes' messages as well as directly. Limited to ``slack`` ticks after the step's start: the
        program must keep a step's inputs until it is computed, and some outputs reach the world late or never.
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
            for reader, edge, _ in reversed(list(self.live())):
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
        """Return the row of each step, for rows of ``n`` ticks: early, but one step of a node a row where possible."""
        rows = {o: -(-lowest[o] // n) for o in self.others}
        # Raise rows until each step comes after the messages that it consumes.
        changed = True
        while changed:
            changed = False
            for name in self.others:
                row = rows[name]
                for reader, edge, newest in self.live():
                    if reader == name and edge.sender != self.world:
                        row = np.maximum(row, get_heard(rows[edge.sender], newest))
                step = self.steps(name)
                spread = np.maximum.accumulate(row - step, axis=1) + step
                row = np.maximum(row, np.minimum(spread, highest[name] // n))
                changed |= bool((row != rows[name]).any())
                rows[name] = row
        return rows

    def _rows_of_supervisor(self) -> Steps:
        """Return the row of each step without a world: one row for each step of the supervisor, other steps early."""
        starts = self.timeline.vertices[self.supervisor].start
        rows = {n: search_rows(starts, np.ascontiguousarray(self.timeline.vertices[n].start)) for n in self.others}
        rows[self.supervisor] = self.steps(self.supervisor).copy()
        changed = True
        while changed:  # a step must not be in an earlier row than the steps whose messages it consumes
            changed = False
            for reader, edge, newest in self.live():
                if reader == self.supervisor:
                    continue
                new = np.maximum.accumulate(np.maximum(rows[reader], get_heard(rows[edge.sender], newest)), axis=1)
                changed |= bool((new != rows[reader]).any())
                rows[reader] = new
        return {n: rows[n] for n in self.others}


def get_heard(of_sender: np.ndarray, newest: np.ndarray) -> np.ndarray:
    """Look up a value of the sender's step that made the newest message of each reader's step; 0 without a message.

    ``of_sender`` has a value for each step of the sender.
    """
    return np.where(newest >= 0, np.take_along_axis(of_sender, newest.clip(0), 1), 0)
