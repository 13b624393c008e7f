"""An interpreter of the index tables in plain Python, which tests the tables without the compiled program."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from oracles.hash_nodes import hash_step

from sim2real.graph.node import BaseNode
from sim2real.runtime.compiled.wiring import InputTable, SlotTable, Wiring

Windows = dict[str, tuple[list[int], list[int]]]
"""Input name -> (seq of each message in the window, value of each), oldest first."""


class TableError(AssertionError):
    """The tables of a wiring contradict each other."""


def interpret(
    nodes: Mapping[str, BaseNode],
    wiring: Wiring,
    episode: int,
    step: Callable[[str, int, Windows], int],
    defaults: Mapping[str, int],
    recorded: Mapping[str, list[int]] | None = None,
) -> dict[str, list[int]]:
    """Play one episode and return the outputs of each node, by seq.

    Args:
        step: Makes a step: (node, seq, windows) -> output.

    Raises:
        TableError: A window has another message than its table, or a node's steps are not in order.
    """
    player = _Player(nodes, wiring, step, defaults, recorded or {})
    for row in range(wiring.rows):
        for name, table in zip(wiring.slots, wiring.tables, strict=True):
            player.play(name, table, (episode, row))
        if wiring.world is not None and wiring.world_table is not None:
            for tick in range(wiring.ticks):
                player.play(wiring.world, wiring.world_table, (episode, row, tick))
    return player.outputs


class _Player:
    """The state of an episode: each node's outputs, and the ring of its last ones."""

    def __init__(
        self,
        nodes: Mapping[str, BaseNode],
        wiring: Wiring,
        step: Callable[[str, int, Windows], int],
        defaults: Mapping[str, int],
        recorded: Mapping[str, list[int]],
    ) -> None:
        self.nodes, self.step, self.defaults, self.recorded = nodes, step, defaults, recorded
        self.rings = {n: [(-1, defaults[n])] * length for n, length in wiring.rings.items()}
        self.outputs: dict[str, list[int]] = {n: [] for n in nodes}

    def play(self, name: str, table: SlotTable, at: tuple[int, ...]) -> None:
        """Make the step in a table's entry; do nothing if the entry has none."""
        seq = int(table.seq[at])
        if seq < 0:
            return
        if seq != len(self.outputs[name]):
            raise TableError(f"node {name!r}: step {seq} follows {len(self.outputs[name])} steps (row {at})")
        windows = {i: self.window(name, i, t, at) for i, t in table.inputs.items()}
        output = self.step(name, seq, windows)
        self.outputs[name].append(output)
        if self.rings[name]:
            self.rings[name] = [*self.rings[name][1:], (seq, output)]

    def window(self, name: str, input_name: str, table: InputTable, at: tuple[int, ...]) -> tuple[list[int], list[int]]:
        """Return the messages of an input, looked up by age as in the compiled program, and checked by ``seq``."""
        connection = self.nodes[name].inputs[input_name]
        sender, width = connection.output_node.name, connection.total_window
        seqs = table.seq[at].tolist()
        if sender in self.recorded:
            messages = self.recorded[sender]
            return seqs, [messages[s] if s >= 0 else self.defaults[sender] for s in seqs]
        ring, age = self.rings[sender], int(table.age[at])
        window = ring[len(ring) - age - width : len(ring) - age]
        if [s for s, _ in window] != seqs:
            where = f"node {name!r}, input {input_name!r}, entry {at}"
            raise TableError(f"{where}: the ring has messages {[s for s, _ in window]}, the table {seqs}")
        return seqs, [x for _, x in window]


def interpret_hashes(
    nodes: Mapping[str, BaseNode], wiring: Wiring, episode: int, states: Mapping[str, int], outputs: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Play one episode of hash nodes.

    Args:
        nodes: Hash nodes (``oracles.hash_nodes``) without trainable delays, by name.
        outputs: Default outputs, numbers.

    Returns:
        The outputs of each node, by seq, uint32.
    """
    current = {n: int(s) for n, s in states.items()}

    def step(name: str, seq: int, windows: Windows) -> int:
        current[name], out = hash_step(current[name], seq, [windows[i] for i in sorted(windows)])
        return out

    played = interpret(nodes, wiring, episode, step, {n: int(x) for n, x in outputs.items()})
    return {n: np.array(values, np.uint32) for n, values in played.items()}
