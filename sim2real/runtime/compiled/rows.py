"""One row of a compiled graph: the steps in its slots, then the world's ticks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.node import BaseNode
from sim2real.runtime.compiled.wiring import SlotTable, Wiring
from sim2real.runtime.init import DelayBounds, bounds_of
from sim2real.runtime.steps import matched
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import Number


T = TypeVar("T")


class Rollout(NamedTuple):
    """A node's steps in a rollout, in order; C is the number of rows times the node's slots (or ticks) per row.

    Attributes:
        seq: Shape ``(C,)``, int32: number of the step; -1 where a slot made no step.
        output: Leaves ``(C, ...)``; meaningless where ``seq`` is -1.
    """

    seq: Number
    output: PyTree


class RowProgram:
    """Traces rows, whose tables are looked up at the state's ``eps`` and ``step``.

    Args:
        reusable: Whether other timelines may follow: then even a slot with a step in every row of these timelines is
            masked.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode],
        wiring: Wiring,
        episodes: int,
        reusable: bool = False,
    ) -> None:
        self.nodes, self.wiring, self.episodes = nodes, wiring, episodes
        self.bounds: DelayBounds = bounds_of(nodes)
        # Shape (R, E, ...): the entries of one row, which all copies look up at once, are adjacent in memory.         #
        # `device_put`, because `jnp.asarray` would compile a program for each shape.
        by_row = lambda t: jax.device_put(t.swapaxes(0, 1))  # noqa: E731
        self._tables = jax.tree_util.tree_map(by_row, [_pytree(t) for t in wiring.tables])
        self._world = jax.tree_util.tree_map(by_row, _pytree(wiring.world_table))
        self._always = [bool((t.seq >= 0).all()) and not reusable for t in wiring.tables]

    @property
    def data(self) -> PyTree:
        """The tables, and the bounds of trainable delays; see ``HoldsData``."""
        return self._tables, self._world, self.bounds

    def with_data(self, nodes: Mapping[str, BaseNode], data: PyTree) -> RowProgram:
        """Return the program with other nodes and data, which may be traced."""
        program = copy.copy(self)
        program.nodes, (program._tables, program._world, program.bounds) = nodes, data
        return program

    def always(self, slot: int) -> bool:
        """Return whether a slot makes a step in every row of every episode."""
        return self._always[slot]

    def run_slots(
        self,
        gs: GraphState,
        begin: int,
        end: int,
        outputs: dict[str, list[Rollout]],
        inside: bool = False,
    ) -> GraphState:
        """Run the slots from ``begin`` to ``end`` of the row; outside of the timelines nothing changes.

        Args:
            outputs: Node -> its steps; the steps of these slots are appended.
            inside: Whether the caller guarantees that the timelines have this row and episode, which saves masking.
        """
        for i in range(begin, end):
            name = self.wiring.slots[i]
            step_state = self.step_state(gs, i, inside)
            new, output = self.call(name, step_state)
            ran = None if inside and self._always[i] else step_state.seq >= 0
            gs = self.commit(gs, name, new, output, ran)
            outputs.setdefault(name, []).append(Rollout(step_state.seq, output))
        return gs

    def run_world(self, gs: GraphState, outputs: dict[str, list[Rollout]], inside: bool = False) -> GraphState:
        """Run the world's ticks and go to the next row; outside of the timelines nothing changes.

        Args:
            outputs: Node -> its steps; the world's ticks are appended.
        """
        name, before, here = self.wiring.world, gs, None if inside else self.within(gs)
        if name is not None:
            # Unrolled on a GPU, where a loop adds latency. On a CPU a loop costs the pendulum nothing, and MuJoCo's
            # worlds compile in half the time.
            unroll = 1 if jax.default_backend() == "cpu" else self.wiring.ticks
            gs, ticks = jax.lax.scan(partial(self._run_tick, name), gs, _at(self._world, gs), unroll=unroll)
            if here is not None:
                ticks = ticks._replace(seq=jnp.where(here, ticks.seq, -1))
            outputs.setdefault(name, []).extend(
                jax.tree_util.tree_map(lambda leaf, i=i: leaf[i], ticks) for i in range(self.wiring.ticks)
            )
        gs = gs.replace(step=gs.step + 1)
        return gs if here is None else select(here, gs, before)

    def _run_tick(self, name: str, gs: GraphState, now: Mapping[str, PyTree]) -> tuple[GraphState, Rollout]:
        """Run one tick of the world; ``now`` has the tick's entries of the table."""
        step_state = self._step_state(gs, name, now)
        new, output = self.call(name, step_state)
        return self.commit(gs, name, new, output, None), Rollout(step_state.seq, output)

    def call(self, name: str, step_state: StepState) -> tuple[StepState, PyTree]:
        """Call a node's step; an exception gets a note with the node's name."""
        try:
            return self.nodes[name].step(step_state)
        except Exception as error:
            error.add_note(f"in the step of node {name!r}")
            raise

    def step_state(self, gs: GraphState, slot: int, inside: bool = False) -> StepState:
        """Return the step state of a slot's step; ``seq`` is -1 if the slot makes no step.

        Args:
            inside: Whether the caller guarantees that the timelines have this row and episode.
        """
        table = _at(self._tables[slot], gs)
        if not inside:
            table["seq"] = self.seq(gs, slot)
        return self._step_state(gs, self.wiring.slots[slot], table)

    def seq(self, gs: GraphState, slot: int) -> jax.Array:
        """Return the number of the step that a slot makes; -1 if it makes none, and outside of the timelines."""
        return jnp.where(self.within(gs), self._tables[slot]["seq"][gs.step, gs.eps], -1)

    def within(self, gs: GraphState) -> Number:
        """Return whether the timelines have the state's episode and row; XLA would clamp an index beyond them."""
        return (gs.step < self.wiring.rows) & (gs.eps >= 0) & (gs.eps < self.episodes)

    def commit(self, gs: GraphState, name: str, new: StepState, output: PyTree, ran: Number | None) -> GraphState:
        """Put the results of a node's step into the graph's state.

        Args:
            ran: Bool scalar, whether the step counts; None: it does, which saves masking.
        """

        def merge(field: str, fresh: T, old: T) -> T:
            if fresh is old:
                return old
            fresh = matched(name, f"the {field} that step returns", fresh, "the one it got", old)
            return fresh if ran is None else select(ran, fresh, old)

        # Replace state and random numbers, and parameters if the step changed them.
        changed: dict[str, PyTree] = {
            field: {**getattr(gs, field), name: merge(field, getattr(new, field), getattr(gs, field)[name])}
            for field in ("state", "rng")
        }
        if new.params is not gs.params[name]:
            changed["params"] = {**gs.params, name: merge("params", new.params, gs.params[name])}
        # Push the output onto the ring of the node.
        if name in gs.buffer:
            ring = gs.buffer[name]
            fresh = matched(name, "the output of step", output, "that of init_output", ring[-1])
            pushed = (*ring[1:], fresh)
            changed["buffer"] = {**gs.buffer, name: pushed if ran is None else select(ran, pushed, ring)}
        return gs.replace(**changed)

    def _step_state(self, gs: GraphState, name: str, table: Mapping[str, PyTree]) -> StepState:
        inputs = {}
        for input_name, t in table["inputs"].items():
            connection = self.nodes[name].inputs[input_name]
            width, age = connection.total_window, t["age"]
            sender = connection.output_node.name
            state = InputState(t["seq"], t["sent"], t["received"], _window(gs.buffer[sender], age, width))

            # A trainable delay picks or interpolates within the window.
            dist = gs.delays.get(name, {}).get(input_name)
            if dist is not None:
                period = 1.0 / self.nodes[name].rate
                opened = self.bounds[name][input_name].opened(dist)
                delayed = opened.apply(state, t["lead"], connection.window, period, table["ts"], connection.skip)
                state = delayed.replace(delay_dist=dist)
            inputs[input_name] = state
        rng, state, params = (part[name] for part in (gs.rng, gs.state, gs.params))
        return StepState(rng, state, params, inputs, gs.eps, table["seq"], table["ts"])


def _window(ring: tuple[T, ...], age: jax.Array, width: int) -> T:
    """Return ``width`` successive outputs of a node, oldest first, after leaving out the ``age`` newest ones.

    The outputs are separate arrays, chosen by selects, which XLA fuses with other elementwise operations. One stacked
    array would cost a GPU a concatenation, a copy and a gather per leaf.
    """
    begin = len(ring) - width
    window = list(ring[begin:])
    for a in range(1, begin + 1):
        window = [select(age == a, ring[begin - a + i], window[i]) for i in range(width)]
    return jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves), *window)


def scan_rows(
    row: Callable[[GraphState], tuple[GraphState, dict[str, list[Rollout]]]],
    gs: GraphState,
    record: Sequence[str],
    rows: int,
    unroll: int,
) -> tuple[GraphState, dict[str, Rollout]]:
    """Run a number of rows in a loop.

    Args:
        row: Runs one row: state -> (state, node -> its steps).

    Returns:
        The last state, and the records by node.
    """

    def body(state: GraphState, _: None) -> tuple[GraphState, dict[str, Rollout]]:
        state, outputs = row(state)
        recorded = {n: outputs.get(n, []) for n in record}
        return state, {n: jax.tree_util.tree_map(lambda *x: jnp.stack(x), *r) for n, r in recorded.items() if r}

    gs, records = jax.lax.scan(body, gs, length=rows, unroll=unroll)
    # (rows, per row, ...) -> (C, ...); not by reshape(-1), which fails for a leaf of size 0
    merge = lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])  # noqa: E731
    return gs, {n: jax.tree_util.tree_map(merge, r) for n, r in records.items()}


def select(mask: Number, new: T, old: T) -> T:
    """Return ``new`` if ``mask`` is true, else ``old``, leaf by leaf.

    MJX's data is one leaf: its own ``where`` skips fields that need no merging.
    """

    def one(a: PyTree, b: PyTree) -> PyTree:
        if a is b:
            return b
        return b.where(mask, a) if _is_mjx_data(b) else jnp.where(mask, a, b)

    return jax.tree_util.tree_map(one, new, old, is_leaf=_is_mjx_data)


def _is_mjx_data(leaf: object) -> bool:
    return type(leaf).__module__.startswith("mujoco.mjx") and hasattr(leaf, "where")


def _pytree(table: SlotTable | None) -> dict[str, PyTree]:
    if table is None:
        return {}
    inputs = {n: {f: getattr(t, f) for f in t.__dataclass_fields__} for n, t in table.inputs.items()}
    return {"seq": table.seq, "ts": table.ts, "inputs": inputs}


def _at(table: T, gs: GraphState) -> T:
    return jax.tree_util.tree_map(lambda t: t[gs.step, gs.eps], table)
