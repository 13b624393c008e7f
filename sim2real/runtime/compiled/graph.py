"""A graph as one compiled program, in which timelines are data and the world always runs.

Timing tables are constants of the program, or its arguments where the caller traces ``with_data``. The state that each
copy carries consists of the nodes' states, the last few outputs of each node, the index of the episode and the row.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.runtime.compiled.rows import Rollout, RowProgram, scan_rows, select
from sim2real.runtime.compiled.wiring import Wiring, check_fit, nodes_of, supervisor_of, wire
from sim2real.runtime.init import OUTPUTS, init_graph_state
from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import Number

T = TypeVar("T")


@runtime_checkable
class HoldsData(Protocol):
    """An object whose methods are traced, with numbers from a recording."""

    @property
    def data(self) -> PyTree:
        """The numbers, a pytree of arrays. Its structure and shapes belong to the program."""
        ...

    def with_data(self, data: PyTree) -> PyTree:
        """Return a copy of this object with other numbers, which may be traced."""
        ...


def data_of(holder: object) -> PyTree:
    """Return an object's data; None if it is no ``HoldsData``."""
    return holder.data if isinstance(holder, HoldsData) else None


def with_data(holder: T, data: PyTree) -> T:
    """Return a copy of an object with other data; the object unchanged if ``data`` is None."""
    changed: PyTree = holder.with_data(data) if data is not None and isinstance(holder, HoldsData) else holder
    return changed


class CompiledGraph:
    """A graph over given timelines, for ``jit``, ``vmap``, ``scan`` and ``grad``.

    A row is the part of an episode that the compiled loop runs in one pass: due steps of the nodes, then a fixed number
    of world ticks. There are three ways to run the graph, each from the state that ``init`` returns:

    - ``rollout``: the supervisor makes its own steps.
    - ``reset`` and ``step``, as in a gym environment: each returns what the supervisor sees at its next step, and the
      caller provides the output. ``run`` is ``step`` with the supervisor's own output.
    - ``observe`` and ``advance``: the same row by row. In some rows the supervisor makes no step.

    Running past the end of the timeline, stepping before a reset, and mixing the three ways are errors. Under ``jit``
    and ``vmap`` the position in the timeline may be traced; past the end, and in an episode that does not exist, the
    state then stays unchanged, and every step state and record has ``seq`` -1.

    Args:
        nodes: The nodes, by name or as a list; nodes that are not in the timeline have no effect.
        supervisor: The node whose steps the caller of ``reset`` and ``step`` makes, usually the policy; or its name.
        timeline: Timelines of one or more episodes.
        reusable: Whether other timelines of the robot, given as ``data``, shall have the same program.

    Raises:
        UsageError: Nodes, connections and timeline do not fit each other.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
        supervisor: str | BaseNode,
        timeline: Timeline,
        reusable: bool = False,
    ) -> None:
        self.nodes = nodes_of(nodes, timeline)
        self.supervisor = supervisor_of(supervisor, self.nodes)
        self.timeline = timeline
        check_fit(self.nodes, timeline, {})
        self.wiring: Wiring = wire(self.nodes, self.supervisor, timeline, reusable)
        self.program = RowProgram(self.nodes, self.wiring, timeline.episodes, reusable)
        # The supervisor may have several slots in a row; call them its turns. Step k of episode e is computed at # `row
        # * turns + turn`, shape `(E, K)`; a step that the program does not compute lies behind the last row.
        self._turns = [i for i, n in enumerate(self.wiring.slots) if n == self.supervisor]
        self._behind = self.rows * len(self._turns)
        self._places = np.zeros((self.episodes, 0), np.int64)
        if self._turns:
            seq = np.stack([self.wiring.tables[i].seq for i in self._turns], axis=-1).reshape(self.episodes, -1)
            self._places = np.full((self.episodes, int(seq.max()) + 1), self._behind)
            e, at = np.nonzero(seq >= 0)
            self._places[e, seq[e, at]] = at
        # On a GPU, unrolling halves the copying of the carried state: 100,000 pendulums on an H200 take 0.63 of the
        # time. On a CPU it costs time to compile.
        self._has_other_data = False
        self._rows_per_pass = 1 if jax.default_backend() == "cpu" else 2

    @property
    def data(self) -> PyTree:
        """The numbers of timelines and delays, and the data of the nodes; see ``HoldsData``."""
        return self.program.data, {n: data_of(node) for n, node in self.nodes.items()}

    def with_data(self, data: PyTree) -> CompiledGraph:
        """Return a copy with other data, which may be traced; for ``rollout``, ``observe`` and ``advance``."""
        graph, (numbers, of_nodes) = copy.copy(self), data
        graph._has_other_data = True
        graph.nodes = {n: with_data(node, of_nodes[n]) for n, node in self.nodes.items()}
        graph.program = self.program.with_data(graph.nodes, numbers)
        return graph

    @property
    def rows(self) -> int:
        """Number of rows of an episode."""
        return self.wiring.rows

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self.timeline.episodes

    @property
    def steps(self) -> int:
        """Number of the supervisor's steps in the shortest episode; ``reset`` returns the first."""
        return int(self._counts().min())

    def last_row(self, steps: np.ndarray) -> np.ndarray:
        """Return the row of step ``steps - 1`` of the supervisor in each episode; both of shape ``(E,)``."""
        computed = (np.arange(self._places.shape[1]) < steps[:, None]) & (self._places < self._behind)
        return np.where(computed, self._places, 0).max(axis=1, initial=0) // max(1, len(self._turns))

    @property
    def turns(self) -> np.ndarray:
        """Mask of the rows with a step of the supervisor, bool of shape ``(episodes, rows)``."""
        return np.any([self.wiring.tables[turn].seq >= 0 for turn in self._turns], axis=0)

    def init(
        self, rng: jax.Array, params: Mapping[str, PyTree] | None = None, order: Sequence[str] = (), eps: Number = 0
    ) -> GraphState:
        """Return the state at the start of an episode.

        Args:
            params: Parameters of some nodes; the other nodes' come from ``init_params``.
            order: Names of nodes that are initialised first.

        Raises:
            UsageError: There is no such episode, or a name is unknown. A traced ``eps`` cannot be checked: in an
                episode that does not exist no step is made.
        """
        self._check_episode(eps)
        gs = init_graph_state(self.nodes, self.supervisor, rng, params, order, self.program.bounds)
        outputs = gs.aux[OUTPUTS]
        buffer = {name: (outputs[name],) * length for name, length in self.wiring.rings.items() if length}
        aux = {k: v for k, v in gs.aux.items() if k != OUTPUTS}
        # A numpy number, not a traced one: later code can then see that this is the first row.
        return gs.replace(eps=jnp.asarray(eps, jnp.int32), step=np.int32(0), seq={}, buffer=buffer, aux=aux)

    def reset(self, gs: GraphState) -> tuple[GraphState, StepState]:
        """Run from the state of ``init`` until the supervisor, usually the policy, is due for the first time.

        Returns:
            The graph's state, whose ``seq`` has the number of the supervisor's next step; and its step state.
        """
        self._check_row_start(gs, "reset")
        self._check_own_timelines("reset")
        gs = self.program.run_slots(gs, 0, self._first_slot(), {})
        arrived = self.program.seq(gs, self._turns[0]) >= 0
        return self._at_step(*self._play_on(gs, jnp.int32(0), arrived, int(self._places[:, 0].max())))

    def step(
        self, gs: GraphState, step_state: StepState | None = None, output: PyTree = None
    ) -> tuple[GraphState, StepState]:
        """Make the supervisor's step, and run from there to its next one.

        Args:
            step_state: The supervisor's step state after the step; None: unchanged.
            output: The step's output; None: the supervisor's ``step`` is called with ``step_state``.

        Returns:
            The graph's state, and the supervisor's next step state.

        Raises:
            UsageError: ``reset`` was not called, or the episode has no further step.
        """
        self._first_slot()
        self._check_own_timelines("step")
        k = self._awaited(gs, "step")
        if not (_traced(k) or _traced(gs.eps)):
            last = int(self._counts()[int(gs.eps)]) - 1
            if not 0 <= int(k) < last:
                raise UsageError(
                    f"the timeline ends after step {last} of the supervisor {self.supervisor!r}",
                    hint="start again with init() and reset(), or draw longer timelines",
                )
        # Make the supervisor's step, then all steps until its next one.
        turn = jnp.asarray(self._places)[gs.eps, jnp.maximum(k, 0)] % len(self._turns)
        before = self._step_state(gs, turn) if step_state is None else step_state
        after, output = self.program.call(self.supervisor, before) if output is None else (before, output)
        gs = self.program.commit(gs, self.supervisor, after, output, k >= 0)
        return self._at_step(*self._play_on(gs, turn, k < 0, int(np.diff(self._places, axis=1).max(initial=1))))

    def run(self, gs: GraphState) -> GraphState:
        """Call the supervisor's own ``step``, and run until its next step is due.

        A state from ``init`` is reset first. Before a ``lax.scan`` call ``reset``: it adds an entry to ``seq``, and the
        carry of a scan must keep its structure.
        """
        return self.step(gs if gs.seq else self.reset(gs)[0])[0]

    def rollout(
        self, gs: GraphState, record: Sequence[str] = (), rows: int | None = None
    ) -> tuple[GraphState, dict[str, Rollout]]:
        """Run the rows of an episode with the supervisor's own ``step``.

        Args:
            rows: Number of rows; default: all remaining rows, or the whole episode if ``gs.step`` is traced.

        Returns:
            The last state, and the records by node.

        Raises:
            UsageError: Fewer than ``rows`` rows remain, or a node in ``record`` does not run.
        """
        self._check_row_start(gs, "rollout")
        left = self.rows if _traced(gs.step) else self.rows - int(gs.step)
        rows = left if rows is None else rows
        if not 1 <= rows <= left:
            raise UsageError(f"{left} of this graph's {self.rows} rows are left, rows={rows}")
        if unknown := [n for n in record if n not in self.nodes]:
            raise UsageError(f"no node {unknown[0]!r} could be recorded. Nodes: {', '.join(self.nodes)}")

        def run_row(state: GraphState) -> tuple[GraphState, dict[str, list[Rollout]]]:
            outputs: dict[str, list[Rollout]] = {}
            state = self.program.run_slots(state, 0, len(self.wiring.slots), outputs, inside)
            return self.program.run_world(state, outputs, inside), outputs

        inside = not _traced(gs.step)
        end, records = scan_rows(run_row, gs, record, rows, self._rows_per_pass)
        if not (inside and _traced(gs.eps)):
            return end, records
        # The rows' updates are not masked: the result of a traced ``eps`` that is no episode has no meaning.
        exists = self.program.within(gs)
        records = {n: r._replace(seq=jnp.where(exists, r.seq, -1)) for n, r in records.items()}
        return select(exists, end, gs.replace(step=end.step)), records

    def observe(self, gs: GraphState, inside: bool = False) -> tuple[GraphState, StepState, Number]:
        """Run a row up to the supervisor's step.

        Args:
            inside: Whether the caller guarantees that the timeline has this episode and this row. It saves masking
                every update.

        Returns:
            The graph's state; the supervisor's step state; and whether the supervisor makes a step in this row.

        Raises:
            UsageError: The supervisor makes several steps in one row.
        """
        self._check_row_start(gs, "observe")
        turn = self._only_slot()
        inside = inside or _is_checked(gs)
        gs = self.program.run_slots(gs, 0, turn, {}, inside)
        step_state = self.program.step_state(gs, turn, inside)
        return gs.replace(seq={self.supervisor: step_state.seq}), step_state, step_state.seq >= 0

    def advance(self, gs: GraphState, step_state: StepState, output: PyTree, inside: bool = False) -> GraphState:
        """Take the supervisor's step and run the rest of the row; the counterpart of ``observe``.

        Args:
            output: The step's output; ignored in a row without a step.

        Returns:
            The state at the start of the next row.
        """
        turn, k = self._only_slot(), self._awaited(gs, "advance")
        inside = inside or _is_checked(gs)
        ran = None if inside and self.program.always(turn) else k >= 0
        gs = self.program.commit(gs.replace(seq={}), self.supervisor, step_state, output, ran)
        gs = self.program.run_slots(gs, turn + 1, len(self.wiring.slots), {}, inside)
        return self.program.run_world(gs, {}, inside)

    def report(self) -> dict[str, Json]:
        """Return figures of the compiled program.

        Returns:
            ``episodes``, ``rows``, ``ticks_per_row``, ``slots`` (the nodes whose steps a row computes, in order),
            ``supervisor_slots``, ``supervisor_steps``, ``longest_gap`` (most rows between two steps of the supervisor),
            ``discarded`` (fraction of the computed steps whose result is not used), ``rings`` (number of outputs kept,
            by node), ``bursts`` (``node/input`` -> the most messages that one step after the first consumes, and the
            length of its window), ``bytes_per_copy`` (size of the carried state).
        """
        w, state = self.wiring, jax.eval_shape(self.init, jax.random.key(0))
        windows = {(n, i): self.nodes[n].inputs[i].total_window for n, i in w.bursts}
        rows = self._places // max(1, len(self._turns))
        return {
            "episodes": self.episodes,
            "rows": w.rows,
            "ticks_per_row": w.ticks,
            "slots": list(w.slots),
            "supervisor_slots": len(self._turns),
            "supervisor_steps": self.steps if self._turns else 0,
            "longest_gap": int(np.diff(rows, axis=1).max(initial=1)),
            "discarded": w.discarded,
            "rings": dict(w.rings),
            "bursts": {f"{n}/{i}": {"burst": b, "window": windows[n, i]} for (n, i), b in w.bursts.items()},
            "bytes_per_copy": sum(x.size * x.dtype.itemsize for x in jax.tree_util.tree_leaves(state)),
        }

    def _counts(self) -> np.ndarray:
        """Return the number of the supervisor's steps in each episode, shape ``(E,)``."""
        return (self._places < self._behind).sum(axis=1)

    def _first_slot(self) -> int:
        """Return the supervisor's first slot; raise a ``UsageError`` if it has none."""
        if self._turns:
            return self._turns[0]
        raise UsageError(
            f"the supervisor {self.supervisor!r} is the world: it ticks in every row, and its steps have no turn",
            hint="make the node that acts the supervisor, or use rollout(), which works with any",
        )

    def _only_slot(self) -> int:
        """Return the supervisor's only slot; raise a ``UsageError`` if it has none, or several."""
        first = self._first_slot()
        if len(self._turns) > 1:
            raise UsageError(
                f"the supervisor {self.supervisor!r} makes up to {len(self._turns)} steps in a row of these timelines",
                hint="draw timelines without bursts, remove the episodes with a hiccup, or use reset() and step()",
            )
        return first

    def _step_state(self, gs: GraphState, turn: Number) -> StepState:
        """Return the supervisor's step state at a turn; ``seq`` is -1 if it makes no step there."""
        step_state = self.program.step_state(gs, self._turns[0])
        for i, slot in enumerate(self._turns[1:], start=1):
            step_state = select(turn == i, self.program.step_state(gs, slot), step_state)
        return step_state

    def _at_step(self, gs: GraphState, turn: Number) -> tuple[GraphState, StepState]:
        """Return the state, whose ``seq`` has the supervisor's next step, and the supervisor's step state."""
        step_state = self._step_state(gs, turn)
        return gs.replace(seq={self.supervisor: step_state.seq}), step_state

    def _play_on(self, gs: GraphState, turn: Number, arrived: Number, hops: int) -> tuple[GraphState, Number]:
        """Run from turn to turn until the supervisor makes a step; return the state and the turn.

        The loop always runs ``hops`` turns, the largest number between two steps. Once the step or the last row is
        reached, the state stays unchanged.
        """
        program, count = self.program, len(self._turns)

        def hop(state: GraphState, i: int) -> GraphState:
            """Run from turn ``i`` to the next turn, in this row or the next one."""
            end = self._turns[i + 1] if i + 1 < count else len(self.wiring.slots)
            state = program.run_slots(state, self._turns[i] + 1, end, {}, inside=True)
            if i + 1 < count:
                return state
            return program.run_slots(program.run_world(state, {}, inside=True), 0, self._turns[0], {})

        def sweep(
            now: tuple[GraphState, jax.Array, jax.Array], _: None
        ) -> tuple[tuple[GraphState, jax.Array, jax.Array], None]:
            for i in range(count):
                state, at, there = now
                active = ~there & program.within(state)
                active = active if count == 1 else active & (at == i)
                after, following = hop(state, i), (i + 1) % count
                reached = program.seq(after, self._turns[following]) >= 0
                now = select(active, (after, jnp.int32(following), reached), now)
            return now, None

        # One row more than the hops need, as the first hop may start at any turn of its row.
        sweeps = hops if count == 1 else -(-hops // count) + (hops > 0)
        start = (gs, jnp.asarray(turn, jnp.int32), jnp.asarray(arrived))
        return jax.lax.scan(sweep, start, length=sweeps)[0][:2] if sweeps != 1 else sweep(start, None)[0][:2]

    def _awaited(self, gs: GraphState, call: str) -> Number:
        """Return the number of the supervisor's step that is due; raise a ``UsageError`` if none is."""
        if self.supervisor not in gs.seq:
            raise UsageError(
                f"{call}() needs a state in which a step of the supervisor {self.supervisor!r} is due",
                hint="call observe() first" if call == "advance" else "call reset() first",
            )
        self._check_episode(gs.eps)
        return gs.seq[self.supervisor]

    def _check_own_timelines(self, call: str) -> None:
        """Refuse other timelines as data: the longest gap between two steps is part of the program."""
        if self._has_other_data:
            raise UsageError(
                f"{call}() plays the graph's own timelines, not other data", hint="use observe() and advance()"
            )

    def _check_episode(self, eps: Number) -> None:
        if not _traced(eps) and not 0 <= int(eps) < self.episodes:
            raise UsageError(f"there is no episode {int(eps)}: the timeline has {self.episodes}")

    def _check_row_start(self, gs: GraphState, call: str) -> None:
        self._check_episode(gs.eps)
        if gs.seq:
            raise UsageError(
                f"{call}() was called while a step of the supervisor {self.supervisor!r} is due",
                hint="start from init(), or go on with advance() or step()",
            )
        if not _traced(gs.step) and (int(gs.step) >= self.rows or (call == "reset" and int(gs.step))):
            raise UsageError(
                f"{call}() was called at row {int(gs.step)} of {self.rows}", hint="start a new episode with init()"
            )


def _is_checked(gs: GraphState) -> bool:
    """Return whether episode and row are numbers, which were checked against the timelines, and not traced."""
    return not (_traced(gs.step) or _traced(gs.eps))


def _traced(x: PyTree) -> bool:
    """Return whether a value is traced, or an array with several values."""
    return isinstance(x, Tracer) or np.ndim(x) > 0
