"""A graph as one program: timing is data, physics is never masked.

Timing tables are constants of the program; the state that each copy carries is the nodes' own, the last few outputs
of each, an episode and a row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.runtime.init import OUTPUTS, init_graph_state
from sim2real.runtime.wiring import SlotTable, Wiring, wire


class Rollout(NamedTuple):
    """What a node did in a rollout, in the order of rows.

    Attributes:
        seq: Shape ``(C,)``, int32: the node's step in each place; -1 where it made none.
        output: Leaves ``(C, ...)``; meaningless where ``seq`` is -1.
    """

    seq: Any
    output: Any


class CompiledGraph:
    """A graph over given timelines, for ``jit``, ``vmap``, ``scan`` and ``grad``.

    Args:
        nodes: The nodes, by name or as a list. Those that the timeline does not hold are left out.
        supervisor: The node at whose steps ``reset`` and ``step`` hand over, usually the policy.
        timeline: What ran when, in one or more episodes.
        given: Nodes that are not run, as their outputs are known: node -> recorded outputs, leaves ``(E, N, ...)``.

    Raises:
        UsageError: When nodes, connections and timeline do not fit each other.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
        supervisor: str,
        timeline: Timeline,
        given: Mapping[str, Any] | None = None,
    ) -> None:
        named = dict(nodes) if isinstance(nodes, Mapping) else {n.name: n for n in nodes}
        self.nodes = {n: node for n, node in named.items() if n in timeline.vertices}
        _check_edges(self.nodes, timeline)
        self.supervisor = supervisor
        self.timeline = timeline
        self.wiring: Wiring = wire(self.nodes, supervisor, timeline, frozenset(given or ()))
        self._given = jax.tree_util.tree_map(jnp.asarray, dict(given or {}))
        self._tables = jax.tree_util.tree_map(jnp.asarray, [_pytree(t) for t in self.wiring.tables])
        self._world = jax.tree_util.tree_map(jnp.asarray, _pytree(self.wiring.world_table))
        self._always = [bool((t.seq >= 0).all()) for t in self.wiring.tables]
        self._turns = [i for i, n in enumerate(self.wiring.slots) if n == supervisor]

    @property
    def rows(self) -> int:
        """Rows of an episode."""
        return self.wiring.rows

    @property
    def episodes(self) -> int:
        """Episodes."""
        return self.timeline.episodes

    def init(
        self,
        rng: jax.Array,
        params: Mapping[str, Any] | None = None,
        order: Sequence[str] = (),
        eps: Any = 0,
    ) -> GraphState:
        """Return the state at the start of an episode.

        Args:
            rng: A JAX key.
            params: Parameters of some nodes; the others' come from ``init_params``.
            order: Nodes that are initialised first.
            eps: Which episode, int or traced.
        """
        gs = init_graph_state(self.nodes, self.supervisor, rng, params, order)
        buffer = {}
        for name, length in self.wiring.rings.items():
            if length:
                buffer[name] = (gs.aux[OUTPUTS][name],) * length
        buffer |= {name: gs.aux[OUTPUTS][name] for name in self._given}
        aux = {k: v for k, v in gs.aux.items() if k != OUTPUTS}
        return gs.replace(  # pyright: ignore[reportAttributeAccessIssue]
            eps=jnp.asarray(eps, jnp.int32), step=jnp.int32(0), seq={}, buffer=buffer, aux=aux
        )

    def run_row(self, gs: GraphState) -> tuple[GraphState, dict[str, list[Rollout]]]:
        """Run one row: every slot of the boundary, then the world's ticks."""
        outputs: dict[str, list[Rollout]] = {}
        gs = self._run_slots(gs, 0, len(self.wiring.slots), outputs)
        return self._run_world(gs, outputs), outputs

    def rollout(
        self, gs: GraphState, record: Sequence[str] = (), rows: int | None = None
    ) -> tuple[GraphState, dict[str, Rollout]]:
        """Run an episode from ``init`` to its last row, or ``rows`` of it.

        Args:
            gs: The state that ``init`` returned.
            record: Nodes whose outputs are returned.
            rows: How many rows; default: all that are left from row 0.

        Returns:
            The last state, and the records by node.

        Raises:
            UsageError: When ``rows`` or ``record`` asks for what is not there.
        """
        rows = self.rows if rows is None else rows
        if not 1 <= rows <= self.rows:
            raise UsageError(f"this graph has {self.rows} rows, {rows} were asked for")
        for name in record:
            if name not in self.nodes:
                raise UsageError(f"no node {name!r} to record. Nodes: {', '.join(self.nodes)}")

        def body(state: GraphState, _: None) -> tuple[GraphState, Any]:
            state, outputs = self.run_row(state)
            kept = {n: outputs.get(n, []) for n in record}
            return state, {n: jax.tree_util.tree_map(lambda *x: jnp.stack(x), *k) for n, k in kept.items() if k}

        # Two rows a pass: a GPU then copies what is carried half as often (0.8 times the time of one a pass at 100,000
        # pendulums on an H200; four cost more). A CPU only compiles longer.
        unroll = 1 if jax.default_backend() == "cpu" else 2
        gs, records = jax.lax.scan(body, gs, length=rows, unroll=unroll)
        merge = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731 - (rows, per row, ...) -> (C, ...)
        return gs, {n: jax.tree_util.tree_map(merge, r) for n, r in records.items()}

    def observe(self, gs: GraphState) -> tuple[GraphState, StepState, Any]:
        """Run the slots of a row before the supervisor's, and return what it sees.

        Returns:
            The graph's state, the supervisor's step state, and whether it makes a step in this row.

        Raises:
            UsageError: When the supervisor makes several steps in one row.
        """
        turn = self._turn()
        gs = self._run_slots(gs, 0, turn, {})
        step_state = self._step_state(gs, self.supervisor, _at(self._tables[turn], gs))
        return gs, step_state, step_state.seq >= 0

    def advance(self, gs: GraphState, step_state: StepState, output: Any) -> GraphState:
        """Put in the supervisor's step and run the rest of the row; the counterpart of ``observe``."""
        turn = self._turn()
        gs = self._commit(gs, turn, step_state, output, step_state.seq >= 0)
        return self._run_world(self._run_slots(gs, turn + 1, len(self.wiring.slots), {}), {})

    def report(self) -> dict[str, Any]:
        """Return what the compiler made of the timelines."""
        w = self.wiring
        return {
            "episodes": self.episodes,
            "rows": w.rows,
            "ticks_per_row": w.ticks,
            "slots": list(w.slots),
            "supervisor_slots": len(self._turns),
            "discarded": w.discarded,
            "rings": dict(w.rings),
        }

    def _turn(self) -> int:
        if len(self._turns) != 1:
            raise UsageError(
                f"the supervisor {self.supervisor!r} makes up to {len(self._turns)} steps in a row of these timelines",
                hint="draw timelines without bursts, or leave the episodes with a hiccup out",
            )
        return self._turns[0]

    def _run_slots(self, gs: GraphState, begin: int, end: int, outputs: dict[str, list[Rollout]]) -> GraphState:
        for i in range(begin, end):
            name = self.wiring.slots[i]
            step_state = self._step_state(gs, name, _at(self._tables[i], gs))
            new, output = self._call(name, step_state)
            gs = self._commit(gs, i, new, output, step_state.seq >= 0)
            outputs.setdefault(name, []).append(Rollout(step_state.seq, output))
        return gs

    def _run_world(self, gs: GraphState, outputs: dict[str, list[Rollout]]) -> GraphState:
        name = self.wiring.world
        if name is not None:
            table = _at(self._world, gs)
            for tick in range(self.wiring.ticks):
                now = jax.tree_util.tree_map(lambda t, i=tick: t[i], table)
                step_state = self._step_state(gs, name, now)
                new, output = self._call(name, step_state)
                gs = self._commit(gs, None, new, output, True)
                outputs.setdefault(name, []).append(Rollout(step_state.seq, output))
        return gs.replace(step=gs.step + 1)  # pyright: ignore[reportAttributeAccessIssue]

    def _call(self, name: str, step_state: StepState) -> tuple[StepState, Any]:
        try:
            return self.nodes[name].step(step_state)
        except Exception as error:
            error.add_note(f"in the step of node {name!r}")
            raise

    def _step_state(self, gs: GraphState, name: str, table: Mapping[str, Any]) -> StepState:
        inputs = {}
        for input_name, t in table["inputs"].items():
            connection = self.nodes[name].inputs[input_name]
            width, age = connection.total_window, t["age"]
            sender = connection.output_node.name
            if sender in self._given:
                data = self._look_up(gs, sender, t["seq"])
            else:
                data = _window(gs.buffer[sender], age, width)
            dist = gs.delays.get(name, {}).get(input_name)
            state = InputState(t["seq"], t["sent"], t["received"], data)
            if dist is not None:
                period = 1.0 / self.nodes[name].rate
                served = dist.apply(state, t["lead"], connection.window, period, table["ts"], connection.skip)
                state = served.replace(delay_dist=dist)
            inputs[input_name] = state
        rng, state, params = (part[name] for part in (gs.rng, gs.state, gs.params))
        return StepState(rng, state, params, inputs, gs.eps, table["seq"], table["ts"])

    def _look_up(self, gs: GraphState, sender: str, seq: Any) -> Any:
        """Return recorded messages by seq; the default output where a slot is empty."""

        def one(recorded: jax.Array, default: jax.Array) -> jax.Array:
            filled = seq.reshape(-1, *[1] * default.ndim) >= 0
            return jnp.where(filled, recorded[gs.eps, jnp.maximum(seq, 0)], default.astype(recorded.dtype))

        return jax.tree_util.tree_map(one, self._given[sender], gs.buffer[sender])

    def _commit(self, gs: GraphState, slot: int | None, new: StepState, output: Any, ran: Any) -> GraphState:
        """Take over a step's results: everywhere if the slot always runs, else where it ran."""
        name = self.wiring.world if slot is None else self.wiring.slots[slot]
        if name is None:
            raise Sim2RealError("a graph without a world has no tick to commit")
        always = slot is None or self._always[slot]

        def merge(fresh: Any, old: Any) -> Any:
            if fresh is old:
                return old
            cast = lambda a, b: jnp.asarray(a) if _is_key(b) else jnp.asarray(a, b.dtype)  # noqa: E731
            fresh = jax.tree_util.tree_map(cast, fresh, old)
            return fresh if always else _select(ran, fresh, old)

        changed: dict[str, Any] = {
            "state": {**gs.state, name: merge(new.state, gs.state[name])},
            "rng": {**gs.rng, name: merge(new.rng, gs.rng[name])},
        }
        if new.params is not gs.params[name]:
            changed["params"] = {**gs.params, name: merge(new.params, gs.params[name])}
        if name in gs.buffer:
            kept = gs.buffer[name]
            fresh = jax.tree_util.tree_map(lambda x, old: jnp.asarray(x, old.dtype), output, kept[-1])
            pushed = (*kept[1:], fresh)
            changed["buffer"] = {**gs.buffer, name: pushed if always else _select(ran, pushed, kept)}
        return gs.replace(**changed)  # pyright: ignore[reportAttributeAccessIssue]


def _window(kept: tuple[Any, ...], age: jax.Array, width: int) -> Any:
    """Return ``width`` of a node's last outputs, oldest first, that end ``age`` before its newest.

    The outputs are kept one by one and chosen by selects: both fuse into one elementwise program, where a stacked ring
    costs a GPU a concatenation, a copy and a gather a leaf.
    """
    spare = len(kept) - width
    window = list(kept[spare:])
    for a in range(1, spare + 1):
        window = [_select(age == a, kept[spare - a + i], window[i]) for i in range(width)]
    return jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves), *window)


def _select(mask: Any, new: Any, old: Any) -> Any:
    return jax.tree_util.tree_map(lambda a, b: jnp.where(mask, a, b), new, old)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _pytree(table: SlotTable | None) -> dict[str, Any]:
    if table is None:
        return {}
    inputs = {n: {f: getattr(t, f) for f in t.__dataclass_fields__} for n, t in table.inputs.items()}
    return {"seq": table.seq, "ts": table.ts, "inputs": inputs}


def _at(table: Any, gs: GraphState) -> Any:
    return jax.tree_util.tree_map(lambda t: t[gs.eps, gs.step], table)


def _check_edges(nodes: Mapping[str, BaseNode], timeline: Timeline) -> None:
    """Every connection between nodes of the graph must have an edge, and the other way round."""
    wanted = {(n, i) for n, node in nodes.items() for i, c in node.inputs.items() if c.output_node.name in nodes}
    missing = sorted(wanted - set(timeline.edges))
    if missing:
        name, input_name = missing[0]
        raise UsageError(
            f"the timeline has no messages for input {input_name!r} of node {name!r}",
            hint="draw them: sim2real.graph.schedule.draw(nodes, duration_s, recorded=timeline)",
        )
    lost = [n for n in timeline.vertices if n not in nodes]
    if lost:
        raise UsageError(f"the timeline holds node {lost[0]!r}, which was not given. Nodes: {', '.join(nodes)}")
    for name, vertex in timeline.vertices.items():
        if not np.isfinite(vertex.start).all() or (np.diff(vertex.start, axis=1) < 0).any():
            raise UsageError(f"the steps of node {name!r} are not in the order of time")
