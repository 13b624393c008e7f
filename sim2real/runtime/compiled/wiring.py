"""Turns timelines into index tables: the step that each slot of each row computes, and the messages that it reads.

A row is a fixed sequence of **slots**, in which steps of the nodes are computed, followed by n world ticks.
``placement.py`` decides which step is computed where. Pure numpy, before anything is compiled;
``tests/oracles/table_interpreter.py`` interprets the tables.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.node import TICKS_PER_S, BaseNode, by_name, check_senders
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import NEVER, Edge, Vertex, search_rows
from sim2real.graph.windows import EMPTY_AGE_S, check_bursts, longest_burst
from sim2real.runtime.compiled.placement import Placement, Placer
from sim2real.types import PyTree


@dataclass(frozen=True)
class InputTable:
    """The messages in an input's window, for every episode and row (and tick of the row, for a world).

    Attributes:
        age: Shape ``(E, R, ...)``, int32: number of the sender's outputs since the newest message in the window.
        seq: Shape ``(E, R, ..., W)``, int32: -1 in empty slots.
        sent: Like ``seq``, float32 [s].
        received: Like ``seq``, float32 [s].
        lead: Like ``seq``, float32: reader's start minus sent time [s]; ``EMPTY_AGE_S`` in empty slots.
    """

    age: np.ndarray
    seq: np.ndarray
    sent: np.ndarray
    received: np.ndarray
    lead: np.ndarray


@dataclass(frozen=True)
class SlotTable:
    """The steps that one slot computes, for every episode and row (and tick of the row, for a world).

    Attributes:
        seq: Shape ``(E, R, ...)``, int32: number of the step; -1: no step.
        ts: Like ``seq``, float32: the step's start [s].
        inputs: Input name -> the messages that the step reads.
    """

    seq: np.ndarray
    ts: np.ndarray
    inputs: Mapping[str, InputTable]


@dataclass(frozen=True)
class Wiring:
    """The tables of a compiled graph.

    Attributes:
        world: Name of the world that ticks in every row; None without a world.
        ticks: Number of world ticks in a row.
        slots: Node of each slot, in the order in which slots run.
        tables: A table for each slot.
        world_table: The world's table; arrays ``(E, R, ticks, ...)``.
        rings: Node -> number of its last outputs that the program carries.
        discarded: Fraction of the slots, over all rows, that compute no step.
        bursts: (node, input) -> the most messages that one step after the first consumes.
    """

    world: str | None
    ticks: int
    rows: int
    slots: tuple[str, ...]
    tables: tuple[SlotTable, ...]
    world_table: SlotTable | None
    rings: Mapping[str, int]
    discarded: float
    bursts: Mapping[tuple[str, str], int]


def wire(
    nodes: Mapping[str, BaseNode],
    supervisor: str,
    timeline: Timeline,
    reusable: bool = False,
) -> Wiring:
    """Turn timelines into index tables.

    Args:
        supervisor: The supervisor's name; a row is at most as long as its period.
        reusable: Whether to round the lengths of rings up, so that most timelines of a robot give the same lengths.
    """
    if supervisor not in timeline.vertices:
        raise UsageError(f"the supervisor {supervisor!r} is not in the timeline. Nodes: {', '.join(timeline.vertices)}")
    check_bursts(nodes, timeline)
    placer = Placer(nodes, supervisor, timeline)
    return _Tables(placer, placer.place(), reusable).wiring()


def messages_read(
    width: int, newest: np.ndarray, ts: np.ndarray, edge: Edge, sender: Vertex
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the messages in the windows of steps: ``seq``, ``sent``, ``received`` and ``lead`` of ``InputTable``.

    Args:
        newest: Shape ``(E, C)``: the newest message that each step has consumed; -1: none, or no step.
        ts: Shape ``(E, C)``: starts of the steps [ticks].
    """
    window = np.maximum(newest[..., None] - np.arange(width - 1, -1, -1), -1)
    flat = window.reshape(len(window), -1).clip(0)
    pick = lambda a: np.where(window >= 0, np.take_along_axis(a, flat, 1).reshape(window.shape), 0)  # noqa: E731
    sent, received = pick(sender.end), pick(edge.received)
    lead = np.where(window >= 0, (ts[..., None] - sent) / TICKS_PER_S, EMPTY_AGE_S)
    seconds = lambda a: (a / TICKS_PER_S).astype(np.float32)  # noqa: E731
    return window.astype(np.int32), seconds(sent), seconds(received), lead.astype(np.float32)


class _Tables:
    """Makes the tables of one placement."""

    def __init__(self, placer: Placer, placement: Placement, reusable: bool = False) -> None:
        self.placer, self.placement, self.reusable = placer, placement, reusable
        self.timeline, self.nodes, self.world = placer.timeline, placer.nodes, placer.world
        self.rows, self.ticks = placement.rows, placement.ticks
        # When the program computes each step: a number that increases with row and slot.
        self.done = {
            n: np.where(placer.valid(n), self._moment(placement.row[n], placement.slot[n]), NEVER)
            for n in placer.others
        }

    def wiring(self) -> Wiring:
        """Return all tables."""
        names = self.placement.slots
        tables = tuple(self._slot_table(n, i) for i, n in enumerate(names))
        world_table = self._world_table() if self.world else None
        ran = [t.seq >= 0 for t in tables]
        return Wiring(
            world=self.world,
            ticks=self.ticks,
            rows=self.rows,
            slots=names,
            tables=tables,
            world_table=world_table,
            rings=self._rings(names, tables, world_table),
            discarded=1.0 - float(np.mean(ran)) if ran else 0.0,
            bursts={k: longest_burst(e, self.timeline.vertices[k[0]]) for k, e in self.placer.edges.items()},
        )

    def _moment(self, row: np.ndarray, slot: np.ndarray | int) -> np.ndarray:
        return row * (len(self.placement.slots) + 1) + slot

    def _slot_table(self, name: str, slot: int) -> SlotTable:
        rows, slots = self.placement.row[name], self.placement.slot[name]
        seq = np.full((self.timeline.episodes, self.rows), -1, np.int64)
        e, k = np.nonzero((slots == slot) & (rows < self.rows) & self.placer.valid(name))
        seq[e, rows[e, k]] = k
        row = np.arange(self.rows, dtype=np.int64)
        return self._table(name, seq, self._moment(row, slot), row * self.ticks)

    def _world_table(self) -> SlotTable:
        world = self.world or ""
        episodes = self.timeline.episodes
        tick = np.arange(self.rows * self.ticks, dtype=np.int64)
        after = self._moment(tick // self.ticks, len(self.placement.slots))  # the row's slots are done
        seq = np.broadcast_to(tick, (episodes, tick.size))
        flat = self._table(world, seq, after, tick)
        split = lambda a: a.reshape(episodes, self.rows, self.ticks, *a.shape[2:])  # noqa: E731
        inputs = {
            n: InputTable(*(split(getattr(t, f)) for f in InputTable.__dataclass_fields__))
            for n, t in flat.inputs.items()
        }
        return SlotTable(split(flat.seq), split(flat.ts), inputs)

    def _table(self, name: str, seq: np.ndarray, moment: np.ndarray, ticks: np.ndarray) -> SlotTable:
        """Return the table of steps ``seq (E, C)``.

        ``moment (C,)``: when the program computes each step; ``ticks (C,)``: the world's number of ticks until then.
        """
        ts = np.where(seq >= 0, np.take_along_axis(self.timeline.vertices[name].start, seq.clip(0), 1), 0)
        # Number of the sender's outputs before each step.
        inputs = {}
        for key, edge in self.placer.edges.items():
            if key[0] != name:
                continue
            if edge.sender == self.world:
                count = np.broadcast_to(ticks, seq.shape)
            else:
                count = search_rows(self.done[edge.sender], np.broadcast_to(moment, seq.shape))
            inputs[key[1]] = self._input_table(key, seq, ts, count)
        return SlotTable(seq.astype(np.int32), (ts / TICKS_PER_S).astype(np.float32), inputs)

    def _input_table(self, key: tuple[str, str], seq: np.ndarray, ts: np.ndarray, count: np.ndarray) -> InputTable:
        """Return the messages that steps read on an input.

        ``seq (E, C)`` and ``ts (E, C)`` [ticks] are the steps and their starts; ``count (E, C)`` is the number of the
        sender's steps before each.
        """
        connection, edge = self.nodes[key[0]].inputs[key[1]], self.placer.edges[key]
        sender: Vertex = self.timeline.vertices[edge.sender]
        # The age of the newest message counts the sender's outputs since.
        newest = np.take_along_axis(self.placer.newest[key], seq.clip(0), 1)
        age = np.where(seq >= 0, count - 1 - newest, 0)
        if (age < 0).any():
            raise UsageError(
                f"input {key[1]!r} of node {key[0]!r} would read a message that has not been computed",
                hint="the timeline's edges contradict its vertices: re-derive it",
            )
        return InputTable(
            age.astype(np.int32),
            *messages_read(connection.total_window, np.where(seq >= 0, newest, -1), ts, edge, sender),
        )

    def _rings(
        self, names: tuple[str, ...], tables: tuple[SlotTable, ...], world_table: SlotTable | None
    ) -> dict[str, int]:
        rings = dict.fromkeys(self.nodes, 0)
        readers = list(zip(names, tables, strict=True))
        if self.world and world_table:
            readers.append((self.world, world_table))
        for reader, table in readers:
            for input_name, t in table.inputs.items():
                connection = self.nodes[reader].inputs[input_name]
                sender = connection.output_node.name
                room = int(t.age.max(initial=0))
                # Round up to 2, 4, 8, ...: one late step makes a recording read older messages than other recordings
                # do.
                if self.reusable and (room or not connection.blocking):
                    room = max(2, 1 << (room - 1).bit_length())
                rings[sender] = max(rings[sender], room + connection.total_window)
        return rings


def nodes_of(nodes: Mapping[str, BaseNode] | Sequence[BaseNode], timeline: Timeline) -> dict[str, BaseNode]:
    """Return the nodes of a timeline by name."""
    named = by_name(nodes)
    missing = [n for n in timeline.vertices if n not in named]
    if missing:
        raise UsageError(f"the timeline holds node {missing[0]!r}, which was not given. Nodes: {', '.join(named)}")
    return {n: node for n, node in named.items() if n in timeline.vertices}


def supervisor_of(supervisor: BaseNode | str, nodes: Mapping[str, BaseNode]) -> str:
    """Return the supervisor's name; ``supervisor`` is the name or the node."""
    if not isinstance(supervisor, str | BaseNode):
        raise UsageError(f"the supervisor is one node, or its name, got {supervisor!r}")
    if isinstance(supervisor, BaseNode) and nodes.get(supervisor.name, supervisor) is not supervisor:
        raise UsageError(f"the supervisor {supervisor!r} is another object than the node of its name in the graph")
    return supervisor if isinstance(supervisor, str) else supervisor.name


def check_fit(nodes: Mapping[str, BaseNode], timeline: Timeline, replayed: Mapping[str, PyTree]) -> None:
    """Check that nodes, connections and timeline fit each other, and that the nodes can be compiled.

    Args:
        replayed: Recorded outputs of nodes that do not run: node -> leaves ``(E, N, ...)``.
    """
    # Nodes, and recorded outputs.
    for name, node in nodes.items():
        if not node.jittable and name not in replayed:
            raise UsageError(
                f"node {name!r} steps in plain Python (jittable = False) and cannot be compiled",
                hint="give its recorded outputs, or put a simulated node in its place",
            )
    check_senders(nodes, among=nodes)
    unknown = [n for n in replayed if n not in nodes]
    if unknown:
        raise UsageError(
            f"the outputs of {unknown[0]!r} are given, which is not in the graph. Nodes: {', '.join(nodes)}"
        )
    for name, recorded in replayed.items():
        _check_replayed(name, recorded, timeline)

    # Every input of a node has messages in the timeline, and the reverse.
    wanted = {(n, i) for n, node in nodes.items() for i, c in node.inputs.items() if c.output_node.name in nodes}
    for name, input_name in sorted(wanted - set(timeline.edges)):
        raise UsageError(
            f"the timeline has no messages for input {input_name!r} of node {name!r}",
            hint="draw them: sim2real.graph.schedule.draw(nodes, duration_s, recorded=timeline)",
        )
    for name, input_name in sorted(set(timeline.edges) - wanted):
        raise UsageError(
            f"the timeline has messages for input {input_name!r} of node {name!r}, which has no such input"
        )

    # Steps and messages are in the order of time.
    for name, vertex in timeline.vertices.items():
        if (np.diff(vertex.start, axis=1) < 0).any():
            raise UsageError(f"the steps of node {name!r} are not in the order of time")
    for (name, input_name), edge in timeline.edges.items():
        consumed = np.where(edge.seq_in < 0, NEVER, edge.seq_in)
        if edge.seq_in.shape != timeline.vertices[edge.sender].start.shape or (np.diff(consumed, axis=1) < 0).any():
            raise UsageError(
                f"the messages for input {input_name!r} of node {name!r} are not one for each step of {edge.sender!r}, "
                "consumed in order",
                hint="make timelines with draw() or Timeline.from_episode()",
            )
        unsent = np.arange(edge.seq_in.shape[1]) >= timeline.vertices[edge.sender].count[:, None]
        if (unsent & (edge.seq_in >= 0)).any():
            raise UsageError(
                f"input {input_name!r} of node {name!r} consumes messages of steps that {edge.sender!r} does not make",
                hint="if you shortened the timeline, compute its edges again: sim2real.graph.rules.consumer",
            )


def _check_replayed(name: str, recorded: PyTree, timeline: Timeline) -> None:
    """Check that there is a recorded output for every step of every episode."""
    steps = int(timeline.vertices[name].count.max(initial=0))
    for path, leaf in pytree.flatten_with_path(recorded)[0]:
        shape = np.shape(leaf)
        if len(shape) < 2 or shape[0] != timeline.episodes or shape[1] < steps:
            raise UsageError(
                f"the given outputs of node {name!r}{''.join(map(str, path))} have shape {shape}: its timeline has "
                f"{timeline.episodes} episodes of up to {steps} steps",
                hint=f"give leaves of shape ({timeline.episodes}, {steps}, ...), an output for each step",
            )
