"""Runs whole episodes in rows that are patterns of steps and ticks (``pattern.py``), for ``CompiledGraph.rollout``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.runtime.compilation.program import Ages, Rollout, RowProgram, scan_rows
from sim2real.runtime.compilation.wiring import InputTable, Wiring
from sim2real.types import PyTree

if TYPE_CHECKING:
    from collections.abc import Iterator


class Repetition:
    """Traces whole episodes as a loop over a pattern, without a mask where each slot makes a step in all episodes.

    The tables bound the age of each message that a slot or tick reads, so most windows need no select. The loop carries
    only the outputs that a later pass reads, and the last output of each node.
    """

    def __init__(self, nodes: Mapping[str, BaseNode], wiring: Wiring, episodes: int) -> None:
        self.nodes, self.wiring = nodes, wiring
        self.world = wiring.world or ""
        ages = [{n: _range(t.age[s.seq >= 0]) for n, t in s.inputs.items()} for s in wiring.tables]
        self.program = RowProgram(nodes, wiring, {}, episodes, ages)
        inputs = wiring.world_table.inputs if wiring.world_table else {}
        self._tick_ages = [{n: _range(t.age[:, :, i]) for n, t in inputs.items()} for i in range(wiring.ticks)]
        self._carried = {n: min(1, length) for n, length in wiring.rings.items()}
        for sender, needed in self._needed():
            self._carried[sender] = max(self._carried[sender], needed)

    def rollout(self, gs: GraphState, record: Sequence[str]) -> tuple[GraphState, dict[str, Rollout]]:
        """Run a whole episode, from the state at its start.

        Args:
            gs: The state; its buffers hold default outputs.

        Returns:
            The last state, and the records by node. In its buffers, outputs that the loop does not carry are the
            default ones.
        """
        # Carry only the outputs that a later row reads.
        wiring, (begin, end), before = self.wiring, self.wiring.full, gs.buffer
        default = {n: ring[-1] for n, ring in before.items()}
        gs = gs.replace(buffer={n: (default[n],) * count for n, count in self._carried.items() if count})

        # Rows before, within and after the range in which each slot makes a step, then the last row.
        parts = []
        for rows, ticks, full in (
            (begin, wiring.ticks, False),
            (end - begin, wiring.ticks, True),
            (wiring.rows - 1 - end, wiring.ticks, False),
            (int(end < wiring.rows), wiring.last, False),
        ):
            if rows > 0:
                gs, part = scan_rows(partial(self._row, default, ticks, full), gs, record, rows, 1)
                parts.append(part)
        buffer = {n: (*ring, *gs.buffer[n])[-len(ring) :] for n, ring in before.items()}
        return gs.replace(buffer=buffer), jax.tree_util.tree_map(lambda *leaves: jnp.concatenate(leaves), *parts)

    def _row(
        self, default: Mapping[str, PyTree], ticks: int, full: bool, gs: GraphState
    ) -> tuple[GraphState, dict[str, list[Rollout]]]:
        """Run one row with its first ``ticks`` ticks; ``full``: each slot makes a step."""
        wiring, carried = self.wiring, gs.buffer
        # The outputs that no step of a row reads before they are replaced.
        unread = {n: (default[n],) * (length - self._carried[n]) for n, length in wiring.rings.items() if length}
        gs = gs.replace(buffer={n: (*blank, *carried.get(n, ())) for n, blank in unread.items()})
        outputs: dict[str, list[Rollout]] = {}
        now = self.program.world_row(gs)
        for slot, (begin, end) in enumerate(self._stretches()):
            for i in range(min(begin, ticks), min(end, ticks)):
                entries = jax.tree_util.tree_map(lambda leaf, i=i: leaf[i], now)
                gs, tick = self.program.run_tick(self.world, gs, entries, self._tick_ages[i])
                outputs.setdefault(self.world, []).append(tick)
            gs = self.program.run_slots(gs, slot, min(slot + 1, len(wiring.slots)), outputs, inside=True, full=full)
        buffer = {n: gs.buffer[n][-count:] for n, count in self._carried.items() if count}
        return gs.replace(step=gs.step + 1, buffer=buffer), outputs

    def _stretches(self) -> Iterator[tuple[int, int]]:
        """Yield the ticks, begin and end, before each slot, and those after the last."""
        ends = (*self.wiring.offsets, self.wiring.ticks)
        return zip((0, *ends[:-1]), ends, strict=True)

    def _needed(self) -> Iterator[tuple[str, int]]:
        """Yield (sender, number of outputs from before the row that are read) of each input of each slot and tick."""
        wiring = self.wiring
        # The readers: the slots of nodes, then the ticks of the world.
        ran = [table.seq >= 0 for table in wiring.tables]
        world = wiring.world_table.inputs if wiring.world_table else {}
        slots = [(wiring.slots[i], t.inputs, wiring.offsets[i], i) for i, t in enumerate(wiring.tables)]
        for i in range(wiring.ticks):
            before = int(np.searchsorted(wiring.offsets, i, side="right"))
            at = {
                n: InputTable(**{f: getattr(t, f)[:, :, i] for f in t.__dataclass_fields__}) for n, t in world.items()
            }
            slots.append((self.world, at, i, before))
        # The ring must reach back to the oldest message of the window.
        for reader, inputs, ticks, before in slots:
            for name, table in inputs.items():
                connection = self.nodes[reader].inputs[name]
                sender = connection.output_node.name
                if sender == self.world:
                    outputs_before = np.minimum(
                        ticks, np.where(np.arange(wiring.rows) < wiring.rows - 1, wiring.ticks, wiring.last)
                    )
                else:
                    outputs_before = sum(ran[j].astype(int) for j in range(before) if wiring.slots[j] == sender)
                used = (table.seq >= 0).any(axis=-1)
                needed = np.where(used, table.age + connection.total_window - outputs_before, 0)
                yield sender, int(needed.max(initial=0))


def _range(age: np.ndarray) -> Ages:
    return (int(age.min()), int(age.max())) if age.size else (0, 0)
