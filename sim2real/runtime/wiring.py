"""From timelines to index tables: what runs in which row of the compiled program, and which messages it reads.

A world ticks on a fixed grid and always runs. Between the last tick that a step sees and the first tick that its output
touches there is slack, so the step can be computed at any tick in between. A **row** is one boundary, where steps of
the other nodes run, followed by n world ticks; n is the largest number for which every step finds a multiple of n in
its slack. Several steps of a node at one boundary take further **slots**. Pure numpy, ahead of time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.node import TICKS_PER_S, BaseNode, BaseWorld
from sim2real.graph.schedule import topological
from sim2real.graph.timeline import Timeline, Vertex, search_rows

_UNREAD = np.int64(2**40)
EMPTY_AGE_S = 1e6
"""Age of an empty slot in a window [s]: older than any message."""


@dataclass(frozen=True)
class InputTable:
    """Which messages an input shows, for every episode, row (and tick of the row, for a world).

    Attributes:
        age: Shape ``(E, R, ...)``, int32: how many messages of the sender are newer than the newest one shown.
        seq: Shape ``(E, R, ..., W)``, int32: -1 in empty slots.
        sent: Like ``seq``, float32 [s].
        received: Like ``seq``, float32 [s].
        lead: Like ``seq``, float32: reader's start minus time of sending [s].
    """

    age: np.ndarray
    seq: np.ndarray
    sent: np.ndarray
    received: np.ndarray
    lead: np.ndarray


@dataclass(frozen=True)
class SlotTable:
    """The steps of one slot: ``seq`` int32 (-1: none) and ``ts`` float32 [s], shape ``(E, R, ...)``, and the inputs."""

    seq: np.ndarray
    ts: np.ndarray
    inputs: Mapping[str, InputTable]


@dataclass(frozen=True)
class Wiring:
    """The tables of a compiled graph.

    Attributes:
        world: The node that ticks in every row; None without a world.
        ticks: World ticks in a row.
        rows: Rows.
        slots: Node of each slot of a boundary, in the order in which they run.
        tables: One for each slot.
        world_table: The world's; arrays ``(E, R, ticks, ...)``.
        rings: Node -> how many of its last outputs are kept.
        discarded: Share of slot computations whose result is not used.
    """

    world: str | None
    ticks: int
    rows: int
    slots: tuple[str, ...]
    tables: tuple[SlotTable, ...]
    world_table: SlotTable | None
    rings: Mapping[str, int]
    discarded: float


def wire(
    nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline, given: frozenset[str] = frozenset()
) -> Wiring:
    """Turn timelines into index tables.

    Args:
        nodes: The nodes by name.
        supervisor: The node whose rate sets the longest row.
        timeline: What ran when.
        given: Nodes whose outputs are known beforehand: they take no slot, and readers look their messages up by seq.

    Raises:
        UsageError: When the supervisor is not in the timeline, or the timeline holds no row.
    """
    if supervisor not in timeline.vertices:
        raise UsageError(f"the supervisor {supervisor!r} is not in the timeline. Nodes: {', '.join(timeline.vertices)}")
    return _Wirer(nodes, supervisor, timeline, given).wire()


class _Wirer:
    def __init__(
        self, nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline, given: frozenset[str]
    ) -> None:
        self.timeline = timeline
        self.given = given
        self.nodes = {n: nodes[n] for n in topological(nodes) if n in timeline.vertices}
        worlds = [n for n in self.nodes.values() if isinstance(n, BaseWorld) and n.name not in given]
        self.world = max(worlds, key=lambda n: n.rate).name if worlds else None
        self.supervisor = supervisor
        self.others = [n for n in self.nodes if n != self.world and n not in given]
        self.edges = {k: e for k, e in timeline.edges.items() if k[0] in self.nodes and e.sender in self.nodes}
        self.newest = {
            k: search_rows(np.where(e.seq_in < 0, np.int64(2**60), e.seq_in), self._all_steps(k[0]), "right") - 1
            for k, e in self.edges.items()
        }

    def _all_steps(self, name: str) -> np.ndarray:
        shape = self.timeline.vertices[name].start.shape
        return np.broadcast_to(np.arange(shape[1], dtype=np.int64), shape)

    def wire(self) -> Wiring:
        lowest, highest = self._earliest(), self._latest()
        if self.world is None:
            ticks, boundary = 1, self._rows_of_supervisor()
            rows = int(self.timeline.vertices[self.supervisor].count.min())
        else:
            ticks, boundary = self._cheapest(lowest, highest)
            rows = int(self.timeline.vertices[self.world].count.min()) // ticks
        if rows < 1:
            raise UsageError("these timelines are shorter than one row", hint="draw longer timelines")
        rounds = self._rounds(boundary)
        slots = self._slots(rounds)
        self.place = {n: (boundary[n] * 64 + rounds[n]) * len(self.nodes) + i for i, n in enumerate(self.others)}
        self.rows, self.ticks = rows, ticks
        tables = tuple(self._slot_table(n, boundary[n], rounds[n], r, i) for r, i, n in slots)
        world_table = self._world_table() if self.world else None
        names = tuple(n for _, _, n in slots)
        ran = [t.seq >= 0 for t in tables]
        discarded = 1.0 - float(np.mean(ran)) if ran else 0.0
        return Wiring(
            self.world, ticks, rows, names, tables, world_table, self._rings(names, tables, world_table), discarded
        )

    def _valid(self, name: str) -> np.ndarray:
        v = self.timeline.vertices[name]
        return np.arange(v.start.shape[1]) < v.count[:, None]

    def _earliest(self) -> dict[str, np.ndarray]:
        """Return for each step how many world ticks it has seen the output of, directly or not."""
        earliest = {n: np.zeros_like(self._all_steps(n)) for n in self.others}
        changed = True
        while changed:  # one pass carries a bound over one connection; loops run through skipped ones and are short
            changed = False
            for (reader, _name), e, newest in self._by_reader():
                if reader == self.world:
                    continue
                if e.sender == self.world:
                    bound = newest + 1
                else:
                    bound = np.where(newest >= 0, np.take_along_axis(earliest[e.sender], newest.clip(0), 1), 0)
                new = np.maximum.accumulate(np.maximum(earliest[reader], bound), axis=1)
                changed |= bool((new != earliest[reader]).any())
                earliest[reader] = new
        return earliest

    def _latest(self) -> dict[str, np.ndarray]:
        """Return for each step the first world tick that its output touches, directly or not."""
        latest = {n: np.full_like(self._all_steps(n), _UNREAD) for n in self.others}
        changed = True
        while changed:
            changed = False
            for (reader, _name), e, _newest in reversed(list(self._by_reader())):
                if e.sender == self.world:
                    continue
                if reader == self.world:
                    bound = np.where(e.seq_in >= 0, e.seq_in, _UNREAD)
                else:
                    bound = np.where(e.seq_in >= 0, np.take_along_axis(latest[reader], e.seq_in.clip(0), 1), _UNREAD)
                new = np.minimum(latest[e.sender], bound)
                new = np.minimum.accumulate(new[:, ::-1], axis=1)[:, ::-1]
                changed |= bool((new != latest[e.sender]).any())
                latest[e.sender] = new
        return latest

    def _by_reader(self):  # noqa: ANN202
        order = list(self.nodes)
        live = [k for k, e in self.edges.items() if e.sender not in self.given and k[0] not in self.given]
        for key in sorted(live, key=lambda k: order.index(k[0])):
            yield key, self.edges[key], self.newest[key]

    def _slots(self, rounds: dict[str, np.ndarray]) -> list[tuple[int, int, str]]:
        """Return (turn, place among the nodes, node) of every slot of a boundary, in the order in which they run."""
        return sorted((int(r), i, n) for i, n in enumerate(self.others) for r in np.unique(rounds[n][self._valid(n)]))

    def _cheapest(
        self, lowest: dict[str, np.ndarray], highest: dict[str, np.ndarray]
    ) -> tuple[int, dict[str, np.ndarray]]:
        """Return the ticks of a row and each step's row: of those that fit every slack, with the fewest slots a tick.

        The largest that fits is not always the best: three steps in ten ticks fit rows of four ticks with two slots
        each, and rows of three with one.
        """
        world = self.nodes[self.world or ""]
        most = max(1, int(np.ceil(world.rate / self.nodes[self.supervisor].rate)))
        best: tuple[float, int, dict[str, np.ndarray]] | None = None
        for n in range(most, 0, -1):
            if n > 1 and not all((-(-lowest[o] // n) * n <= highest[o])[self._valid(o)].all() for o in self.others):
                continue
            boundary = self._boundaries(lowest, highest, n)
            cost = len(self._slots(self._rounds(boundary))) / n
            if best is None or cost < best[0]:
                best = (cost, n, boundary)
        if best is None:
            raise UsageError("no step of these timelines can be placed between the world's ticks")
        return best[1], best[2]

    def _boundaries(
        self, lowest: dict[str, np.ndarray], highest: dict[str, np.ndarray], n: int
    ) -> dict[str, np.ndarray]:
        """Return the row of each step: as early as it can be, one step of a node in a row where the slack allows it."""
        rows = {o: -(-lowest[o] // n) for o in self.others}
        changed = True
        while changed:
            changed = False
            for name in self.others:
                row = rows[name]
                for (reader, _name), e, newest in self._by_reader():
                    if reader == name and e.sender != self.world:
                        heard = np.where(newest >= 0, np.take_along_axis(rows[e.sender], newest.clip(0), 1), 0)
                        row = np.maximum(row, heard)
                step = self._all_steps(name)
                spread = np.maximum.accumulate(row - step, axis=1) + step
                row = np.maximum(row, np.minimum(spread, highest[name] // n))
                changed |= bool((row != rows[name]).any())
                rows[name] = row
        return rows

    def _rows_of_supervisor(self) -> dict[str, np.ndarray]:
        """Without a world a row is one step of the supervisor; the others run as early as their inputs allow."""
        starts = self.timeline.vertices[self.supervisor].start
        rows = {n: search_rows(starts, np.ascontiguousarray(self.timeline.vertices[n].start)) for n in self.others}
        rows[self.supervisor] = self._all_steps(self.supervisor).copy()
        changed = True
        while changed:  # a step never runs in a row before those of the steps that it hears
            changed = False
            for (reader, _name), e, newest in self._by_reader():
                if reader == self.supervisor:
                    continue
                bound = np.where(newest >= 0, np.take_along_axis(rows[e.sender], newest.clip(0), 1), 0)
                new = np.maximum.accumulate(np.maximum(rows[reader], bound), axis=1)
                changed |= bool((new != rows[reader]).any())
                rows[reader] = new
        return rows

    def _rounds(self, boundary: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return for each step its turn at the boundary: after what it hears and after the node's step before."""
        order = {n: i for i, n in enumerate(self.nodes)}
        rounds = {n: np.zeros_like(b) for n, b in boundary.items()}
        changed = True
        while changed:
            changed = False
            for name, b in boundary.items():
                new = rounds[name].copy()
                again = b[:, 1:] == b[:, :-1]
                new[:, 1:] = np.where(again, np.maximum(new[:, 1:], new[:, :-1] + 1), new[:, 1:])
                for key, e, at in self._by_reader():
                    if key[0] != name or e.sender == self.world:
                        continue
                    heard_here = (at >= 0) & (np.take_along_axis(boundary[e.sender], at.clip(0), 1) == b)
                    turn = np.take_along_axis(rounds[e.sender], at.clip(0), 1) + (order[e.sender] >= order[name])
                    new = np.where(heard_here, np.maximum(new, turn), new)
                changed |= bool((new != rounds[name]).any())
                rounds[name] = new
            if max(int(r.max(initial=0)) for r in rounds.values()) >= 64:
                raise UsageError(
                    "a node makes more than 64 steps between two ticks of the world",
                    hint="raise the world's rate, or lower the node's",
                )
        return rounds

    def _slot_table(self, name: str, boundary: np.ndarray, rounds: np.ndarray, turn: int, index: int) -> SlotTable:
        episodes = self.timeline.episodes
        seq = np.full((episodes, self.rows), -1, np.int64)
        e, k = np.nonzero((rounds == turn) & (boundary < self.rows) & self._valid(name))
        seq[e, boundary[e, k]] = k
        here = (np.arange(self.rows) * 64 + turn) * len(self.nodes) + index
        done = {
            n: search_rows(self._places(n), np.broadcast_to(here, (episodes, self.rows)).astype(np.int64))
            for n in self._senders(name)
        }
        if self.world:
            done[self.world] = np.broadcast_to(np.arange(self.rows) * self.ticks, seq.shape)
        return self._table(name, seq, done)

    def _world_table(self) -> SlotTable:
        world = self.world or ""
        episodes = self.timeline.episodes
        tick = np.arange(self.rows * self.ticks, dtype=np.int64)
        seq = np.broadcast_to(tick, (episodes, tick.size))
        after = (tick // self.ticks * 64 + 63) * len(self.nodes) + len(self.nodes)  # the whole boundary is done
        done = {
            n: search_rows(self._places(n), np.broadcast_to(after, seq.shape).astype(np.int64))
            for n in self._senders(world)
        }
        done[world] = seq
        flat = self._table(world, seq, done)
        split = lambda a: a.reshape(episodes, self.rows, self.ticks, *a.shape[2:])  # noqa: E731
        inputs = {
            n: InputTable(*(split(getattr(t, f)) for f in InputTable.__dataclass_fields__))
            for n, t in flat.inputs.items()
        }
        return SlotTable(split(flat.seq), split(flat.ts), inputs)

    def _senders(self, name: str) -> set[str]:
        return {e.sender for (reader, _), e, _ in self._by_reader() if reader == name} - {self.world}

    def _places(self, name: str) -> np.ndarray:
        return np.where(self._valid(name), self.place[name], np.int64(2**60))

    def _table(self, name: str, seq: np.ndarray, done: Mapping[str, np.ndarray]) -> SlotTable:
        """Return the table of steps ``seq`` (E, C), before which each sender has made ``done`` steps."""
        ts = np.where(seq >= 0, np.take_along_axis(self.timeline.vertices[name].start, seq.clip(0), 1), 0)
        inputs = {
            key[1]: self._input_table(key, seq, ts, done.get(e.sender))
            for key, e in self.edges.items()
            if key[0] == name
        }
        return SlotTable(seq.astype(np.int32), (ts / TICKS_PER_S).astype(np.float32), inputs)

    def _input_table(
        self, key: tuple[str, str], seq: np.ndarray, ts: np.ndarray, done: np.ndarray | None
    ) -> InputTable:
        connection, edge = self.nodes[key[0]].inputs[key[1]], self.edges[key]
        sender: Vertex = self.timeline.vertices[edge.sender]
        newest = np.take_along_axis(self.newest[key], seq.clip(0), 1)
        age = np.zeros_like(seq) if done is None else np.where(seq >= 0, done - 1 - newest, 0)
        if (age < 0).any():
            raise UsageError(
                f"input {key[1]!r} of node {key[0]!r} would read a message that has not been computed",
                hint="the timeline's edges contradict its vertices: re-derive it",
            )
        window = np.maximum(newest[..., None] - np.arange(connection.total_window - 1, -1, -1), -1)
        window = np.where(seq[..., None] >= 0, window, -1)
        flat = window.reshape(len(seq), -1)
        pick = lambda a: np.where(  # noqa: E731
            window >= 0, np.take_along_axis(a, flat.clip(0), 1).reshape(window.shape), 0
        )
        sent, received = pick(sender.end), pick(edge.received)
        lead = np.where(window >= 0, (ts[..., None] - sent) / TICKS_PER_S, EMPTY_AGE_S)
        seconds = lambda a: (a / TICKS_PER_S).astype(np.float32)  # noqa: E731
        return InputTable(
            age.astype(np.int32), window.astype(np.int32), seconds(sent), seconds(received), lead.astype(np.float32)
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
                if sender in self.given:
                    continue
                rings[sender] = max(rings[sender], int(t.age.max(initial=0)) + connection.total_window)
        return rings
