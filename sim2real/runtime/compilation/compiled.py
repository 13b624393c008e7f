"""A graph as one compiled program, in which timelines are data and the world always runs.

Timing tables are constants of the program, or its arguments where the caller traces ``with_data``. The state that each
copy carries consists of the nodes' states, the last few outputs of each node, the index of the episode and the row.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.runtime.compilation.fit import check_fit, nodes_of, supervisor_of
from sim2real.runtime.compilation.program import Rollout, RowProgram, has_mjx_data, scan_rows, select
from sim2real.runtime.compilation.repetition import Repetition
from sim2real.runtime.compilation.report import report_of
from sim2real.runtime.compilation.walk import Walk
from sim2real.runtime.compilation.wiring import Wiring, wire, wire_pattern
from sim2real.runtime.init import OUTPUTS, init_graph_state
from sim2real.runtime.program_arguments import data_of, with_data
from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import Number


T = TypeVar("T")


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
        given: Recorded outputs of nodes that do not run: node -> leaves ``(E, N, ...)``.
        reusable: Whether other timelines of the robot, given as ``data``, shall have the same program.

    Attributes:
        rows_per_pass: Unroll factor of ``rollout``'s loop over rows.
        walk: The steps of the supervisor in the rows.

    Raises:
        UsageError: Nodes, connections and timeline do not fit each other.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
        supervisor: str | BaseNode,
        timeline: Timeline,
        given: Mapping[str, PyTree] | None = None,
        reusable: bool = False,
    ) -> None:
        self.nodes = nodes_of(nodes, timeline)
        self.supervisor = supervisor_of(supervisor, self.nodes)
        self.timeline = timeline
        self.replayed = tuple(given or ())
        check_fit(self.nodes, timeline, given or {})
        self.wiring: Wiring = wire(self.nodes, self.supervisor, timeline, frozenset(self.replayed), reusable)
        self.program = RowProgram(self.nodes, self.wiring, given or {}, timeline.episodes, reusable=reusable)
        self.walk = Walk(self.program, self.supervisor)
        # Unrolling halves a GPU's copies of the carried state: 100,000 pendulums on an H200 take 0.63 of the time. On a
        # CPU it costs time to compile.
        self.rows_per_pass = 1 if jax.default_backend() == "cpu" else 2

    @cached_property
    def repetition(self) -> Repetition | None:
        """The program of whole episodes in a pattern that all repeat; None without a pattern, or with ``given``."""
        pattern = None if self.replayed else wire_pattern(self.nodes, self.supervisor, self.timeline)
        if pattern is not None and np.diff(pattern.full) < 2:
            return None
        with jax.ensure_compile_time_eval():  # the first rollout may be traced
            return pattern and Repetition(self.nodes, pattern, self.episodes)

    @property
    def data(self) -> PyTree:
        """The numbers of timelines and delays, and the data of the nodes; see ``HoldsData``."""
        return self.program.data, {n: data_of(node) for n, node in self.nodes.items()}

    def with_data(self, data: PyTree) -> CompiledGraph:
        """Return a copy with other data, which may be traced; its rollouts run in rows."""
        graph, (numbers, of_nodes) = copy.copy(self), data
        graph.nodes = {n: with_data(node, of_nodes[n]) for n, node in self.nodes.items()}
        graph.program = self.program.with_data(graph.nodes, numbers)
        graph.walk, graph.repetition = Walk(graph.program, self.supervisor), None
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
        return int(self.walk.counts.min())

    def last_row(self, steps: np.ndarray) -> np.ndarray:
        """Return the row of the last of the supervisor's first ``steps (E,)`` steps in each episode, ``(E,)``."""
        return self.walk.last_row(steps)

    @property
    def turns(self) -> np.ndarray:
        """Mask of the rows with a step of the supervisor, bool of shape ``(episodes, rows)``."""
        return np.any([self.wiring.tables[turn].seq >= 0 for turn in self.walk.turns], axis=0)

    def init(
        self, rng: jax.Array, params: Mapping[str, PyTree] | None = None, order: Sequence[str] = (), eps: Number = 0
    ) -> GraphState:
        """Return the state at the start of an episode.

        Args:
            params: Parameters of some nodes; the other nodes' come from ``init_params``.
            order: Names of nodes that are initialised first.

        Raises:
            UsageError: When there is no such episode, or a name is unknown. A traced ``eps`` cannot be checked: in an
                episode that does not exist no step is made.
        """
        self._check_episode(eps)
        gs = init_graph_state(self.nodes, self.supervisor, rng, params, order, self.program.bounds)
        outputs = gs.aux[OUTPUTS]
        buffer = {name: (outputs[name],) * length for name, length in self.wiring.rings.items() if length}
        self.program.check_given(outputs)
        buffer |= {name: outputs[name] for name in self.replayed}
        aux = {k: v for k, v in gs.aux.items() if k != OUTPUTS}
        # A numpy number, not a traced one: code later in the same program can see that this is the first row.
        return gs.replace(eps=jnp.asarray(eps, jnp.int32), step=np.int32(0), seq={}, buffer=buffer, aux=aux)

    def reset(self, gs: GraphState) -> tuple[GraphState, StepState]:
        """Run from the state of ``init`` to the supervisor's first step.

        Returns:
            The graph's state, whose ``seq`` has the number of the supervisor's next step; and its step state.
        """
        self._check_row_start(gs, "reset")
        return self.walk.to_first(gs)

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
        self.walk.first_turn()
        k = self._awaited(gs, "step")
        if not (_traced(k) or _traced(gs.eps)):
            last = int(self.walk.counts[int(gs.eps)]) - 1
            if not 0 <= int(k) < last:
                raise UsageError(
                    f"the timeline ends after step {last} of the supervisor {self.supervisor!r}",
                    hint="start again with init() and reset(), or draw longer timelines",
                )
        # Make the supervisor's step, then all steps until its next one.
        turn = self.walk.turn_of(gs, k)
        before = self.walk.step_state(gs, turn) if step_state is None else step_state
        after, output = self.program.call(self.supervisor, before) if output is None else (before, output)
        gs = self.program.commit(gs, self.supervisor, after, output, k >= 0)
        return self.walk.to_next(gs, turn, k < 0)

    def run(self, gs: GraphState) -> GraphState:
        """Make the supervisor's next step by its own ``step``, and run to the step after it.

        A state from ``init`` is reset first. With a scan, call ``reset`` before the loop: it adds an entry to ``seq``,
        and a loop's carry must keep its structure.
        """
        return self.step(gs if gs.seq else self.reset(gs)[0])[0]

    def run_row(self, gs: GraphState) -> tuple[GraphState, dict[str, list[Rollout]]]:
        """Run one row: the due steps of the nodes, then the world's ticks.

        Returns:
            The graph's state, and each node's steps of the row.
        """
        self._check_row_start(gs, "run_row")
        return self._run_row(gs, _is_checked(gs))

    def rollout(
        self, gs: GraphState, record: Sequence[str] = (), rows: int | None = None
    ) -> tuple[GraphState, dict[str, Rollout]]:
        """Run the rows of an episode, the supervisor making its own steps.

        Args:
            rows: Number of rows; default: all remaining rows, or the whole episode if ``gs.step`` is traced. A whole
                episode runs in a pattern if there is one, see ``repetition``: to the world's last tick, in another
                order of the records' places.

        Returns:
            The last state, and the records by node.

        Raises:
            UsageError: Fewer than ``rows`` rows remain, or a node in ``record`` does not run.
        """
        self._check_row_start(gs, "rollout")
        fresh = rows is None and not _traced(gs.step) and not int(gs.step)
        # XLA compiles each tick of MJX for seconds, and masks do not slow it down: rows have fewer ticks.
        if fresh and not has_mjx_data(gs.state) and self.repetition is not None:
            self._check_record(record)
            end, records = self.repetition.rollout(gs, record)
            return self._of_existing(gs, end.replace(step=np.int32(self.rows)), records)
        left = self.rows if _traced(gs.step) else self.rows - int(gs.step)
        rows = left if rows is None else rows
        if not 1 <= rows <= left:
            raise UsageError(f"{left} of this graph's {self.rows} rows are left, rows={rows}")
        self._check_record(record)
        inside = not _traced(gs.step)
        end, records = scan_rows(lambda state: self._run_row(state, inside), gs, record, rows, self.rows_per_pass)
        return self._of_existing(gs, end, records) if inside else (end, records)

    def _of_existing(
        self, begin: GraphState, end: GraphState, records: dict[str, Rollout]
    ) -> tuple[GraphState, dict[str, Rollout]]:
        """Return the results of rows whose updates are not masked: none where a traced ``eps`` is no episode."""
        if not _traced(begin.eps):
            return end, records
        exists = self.program.within(begin)
        records = {n: r._replace(seq=jnp.where(exists, r.seq, -1)) for n, r in records.items()}
        return select(exists, end, begin.replace(step=end.step)), records

    def _check_record(self, record: Sequence[str]) -> None:
        for name in record:
            if name not in self.nodes or name in self.replayed:
                running = [n for n in self.nodes if n not in self.replayed]
                raise UsageError(f"no node {name!r} runs that could be recorded. Nodes: {', '.join(running)}")

    def observe(self, gs: GraphState, inside: bool = False) -> tuple[GraphState, StepState, Number]:
        """Run a row up to the supervisor's step.

        Args:
            inside: Promise that the row is not past the end of the timeline, because episodes end earlier, and that
                the timeline has the episode. It saves masking every update.

        Returns:
            The graph's state; the supervisor's step state; and whether the supervisor makes a step in this row.

        Raises:
            UsageError: The supervisor makes several steps in one row.
        """
        self._check_row_start(gs, "observe")
        turn = self.walk.only_turn()
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
        turn, k = self.walk.only_turn(), self._awaited(gs, "advance")
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
        return report_of(self.walk, jax.eval_shape(self.init, jax.random.key(0)))

    def _run_row(self, gs: GraphState, inside: bool) -> tuple[GraphState, dict[str, list[Rollout]]]:
        outputs: dict[str, list[Rollout]] = {}
        gs = self.program.run_slots(gs, 0, len(self.wiring.slots), outputs, inside)
        return self.program.run_world(gs, outputs, inside), outputs

    def _awaited(self, gs: GraphState, call: str) -> Number:
        """Return the number of the supervisor's step that the caller makes next."""
        if self.supervisor not in gs.seq:
            raise UsageError(
                f"{call}() needs a state in which a step of the supervisor {self.supervisor!r} awaits",
                hint="call observe() first" if call == "advance" else "call reset() first",
            )
        self._check_episode(gs.eps)
        return gs.seq[self.supervisor]

    def _check_episode(self, eps: Number) -> None:
        if not _traced(eps) and not 0 <= int(eps) < self.episodes:
            raise UsageError(f"there is no episode {int(eps)}: the timeline has {self.episodes}")

    def _check_row_start(self, gs: GraphState, call: str) -> None:
        self._check_episode(gs.eps)
        if gs.seq:
            raise UsageError(
                f"{call}() was called while a step of the supervisor {self.supervisor!r} awaits",
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
