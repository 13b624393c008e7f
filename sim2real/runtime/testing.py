"""An interpreter of the index tables in plain Python: does what the compiled program does, to test the tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from sim2real.graph.node import BaseNode
from sim2real.graph.testing.nodes import hash_step
from sim2real.runtime.compilation.wiring import SlotTable, Wiring

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
    given: Mapping[str, list[int]] | None = None,
) -> dict[str, list[int]]:
    """Play one episode and return the outputs of each node, by seq.

    Messages are looked up as in the compiled program, by their age in a buffer of the sender's last outputs, and each
    is checked against the ``seq`` that the tables also have.

    Args:
        step: Makes a step: (node, seq, windows) -> output.
        given: Outputs of nodes that do not run.

    Raises:
        TableError: When a window has another message than the table says, or a node's steps are not in order.
    """
    rings = {n: [(-1, defaults[n])] * length for n, length in wiring.rings.items()}
    made: dict[str, list[int]] = {n: [] for n in nodes}

    def one(name: str, table: SlotTable, at: tuple[int, ...]) -> None:
        seq = int(table.seq[at])
        if seq < 0:
            return
        if seq != len(made[name]):
            raise TableError(f"node {name!r}: step {seq} comes when {len(made[name])} steps are made (row {at})")
        windows = {}
        for input_name, t in table.inputs.items():
            connection = nodes[name].inputs[input_name]
            sender, width = connection.output_node.name, connection.total_window
            seqs = t.seq[at].tolist()
            if given and sender in given:
                windows[input_name] = seqs, [given[sender][s] if s >= 0 else defaults[sender] for s in seqs]
                continue
            ring, age = rings[sender], int(t.age[at])
            shown = ring[len(ring) - age - width : len(ring) - age]
            if [s for s, _ in shown] != seqs:
                where = f"node {name!r}, input {input_name!r}, step {seq}"
                raise TableError(f"{where}: the ring shows {[s for s, _ in shown]}, the table says {seqs}")
            windows[input_name] = seqs, [x for _, x in shown]
        output = step(name, seq, windows)
        made[name].append(output)
        if rings[name]:
            rings[name] = [*rings[name][1:], (seq, output)]

    for row in range(wiring.rows):
        last = wiring.last if row == wiring.rows - 1 else wiring.ticks
        done = 0
        for name, table, offset in zip(
            (*wiring.slots, ""), (*wiring.tables, None), (*wiring.offsets, wiring.ticks), strict=True
        ):
            if wiring.world is not None and wiring.world_table is not None:
                for tick in range(done, min(offset, last)):
                    one(wiring.world, wiring.world_table, (episode, row, tick))
            done = max(done, min(offset, last))
            if table is not None:
                one(name, table, (episode, row))
    return made


def interpret_hashes(
    nodes: Mapping[str, BaseNode],
    wiring: Wiring,
    episode: int,
    states: Mapping[str, int],
    outputs: Mapping[str, int],
) -> dict[str, np.ndarray]:
    """Play one episode of hash nodes.

    Args:
        nodes: Hash nodes (``sim2real.graph.testing``) without trainable delays, by name.
        outputs: Default outputs, numbers.

    Returns:
        The outputs of each node, by seq, uint32.
    """
    current = {n: int(s) for n, s in states.items()}

    def step(name: str, seq: int, windows: Windows) -> int:
        current[name], out = hash_step(current[name], seq, [windows[i] for i in sorted(windows)])
        return out

    made = interpret(nodes, wiring, episode, step, {n: int(x) for n, x in outputs.items()})
    return {n: np.array(values, np.uint32) for n, values in made.items()}
