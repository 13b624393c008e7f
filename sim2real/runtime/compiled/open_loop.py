"""A graph whose computed nodes form no loop, run node by node, with its timing as an argument.

Identification feeds recorded commands to the world, and the world's outputs to the sensor. Such a graph needs no rows
and no rings of outputs (``sim2real.runtime.compiled.graph``): each node makes all of its steps, then its readers make
theirs and look messages up by ``seq``. The program depends only on the number of steps, so one program serves logs of
equal length.
"""

import graphlib
from collections.abc import Callable, Collection, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.node import TICKS_PER_S, BaseNode, BaseWorld
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import check_bursts, newest_message
from sim2real.runtime.compiled.wiring import check_fit, messages_read
from sim2real.runtime.init import OUTPUTS, init_graph_state
from sim2real.runtime.steps import matched
from sim2real.types import PyTree

Tables = dict[str, PyTree]
"""Node -> ``seq`` and ``ts`` of its steps, leaves ``(E, K)``, and ``inputs``: input name -> ``seq``, ``sent``,
``received`` and ``lead`` of the messages in each step's window, leaves ``(E, K, W)``. After an episode's last step
``seq`` is -1.
"""
Step = Callable[[StepState], tuple[StepState, PyTree]]


class OpenLoopGraph:
    """A graph whose computed nodes can run one after the other.

    Args:
        replayed: Nodes that do not run, as their outputs are recorded.

    Attributes:
        order: The computed nodes, senders before readers.
        world: The fastest world among the computed nodes; None without a world.

    Raises:
        UsageError: Computed nodes form a loop.
    """

    def __init__(self, nodes: Mapping[str, BaseNode], supervisor: str, replayed: Collection[str]) -> None:
        self.nodes, self.supervisor, self.replayed = dict(nodes), supervisor, frozenset(replayed)
        senders = {
            n: {c.output_node.name for c in node.inputs.values()} - self.replayed
            for n, node in self.nodes.items()
            if n not in self.replayed
        }
        # Compute senders before readers.
        try:
            self.order = tuple(graphlib.TopologicalSorter(senders).static_order())
        except graphlib.CycleError as error:
            raise UsageError(
                f"nodes read each other's messages in a loop: {' -> '.join(error.args[1])}",
                hint="give the recorded outputs of one of them",
            ) from None
        worlds = [self.nodes[n] for n in self.order if isinstance(self.nodes[n], BaseWorld)]
        self.world = max(worlds, key=lambda n: n.rate).name if worlds else None

    def tables(self, timeline: Timeline, replayed: Mapping[str, PyTree]) -> Tables:
        """Return the timing of all computed steps.

        Args:
            replayed: Node -> recorded outputs, leaves ``(E, N, ...)``.

        Raises:
            UsageError: Nodes and timeline do not fit, or a window is too short for a burst of messages.
        """
        check_fit(self.nodes, timeline, replayed)
        check_bursts(self.nodes, timeline)
        tables: Tables = {}
        for name in self.order:
            vertex = timeline.vertices[name]
            steps = np.broadcast_to(np.arange(vertex.start.shape[1]), vertex.start.shape)
            seq = np.where(steps < vertex.count[:, None], steps, -1)
            inputs = {i: _window(self.nodes, timeline, name, i, seq) for n, i in timeline.edges if n == name}
            ts = (np.where(seq >= 0, vertex.start, 0) / TICKS_PER_S).astype(np.float32)
            tables[name] = {"seq": seq.astype(np.int32), "ts": ts, "inputs": inputs}
        return tables

    def begin(self, params: Mapping[str, PyTree], defaults: Mapping[str, PyTree], eps: PyTree) -> GraphState:
        """Return the state in which an episode starts.

        Args:
            params: Parameters of some nodes; the other nodes' come from ``init_params``.
            defaults: Default outputs that replace those of ``init_output``: node -> a message.
            eps: The episode's number, which steps receive.
        """
        gs = init_graph_state(self.nodes, self.supervisor, jax.random.key(0), params)
        outputs = dict(gs.aux[OUTPUTS])
        for name, message in defaults.items():
            outputs[name] = pytree.map(lambda new, old: jnp.asarray(new, old.dtype), message, outputs[name])
        return gs.replace(eps=eps, aux={OUTPUTS: outputs})

    def run(
        self,
        gs: GraphState,
        tables: Tables,
        replayed: Mapping[str, PyTree],
        record: str,
        known: Mapping[str, PyTree] | None = None,
    ) -> PyTree:
        """Run an episode and return a node's outputs, leaves ``(K, ...)``.

        Args:
            tables: The tables of this episode: leaves ``(K, ...)``.
            replayed: Node -> its recorded messages, leaves ``(N, ...)``.
            known: Outputs of nodes that were computed elsewhere: node -> leaves ``(1 + K, ...)``, the default first.
        """
        sent = {n: _with_default(gs.aux[OUTPUTS][n], rows) for n, rows in replayed.items()} | dict(known or {})
        for name in self.order:
            if name not in sent:
                outputs = self._scan(name, gs, tables[name], sent, self._step_of(name, gs))
                if name == record:
                    return outputs
                sent[name] = _with_default(gs.aux[OUTPUTS][name], outputs)
        raise UsageError(f"no node {record!r} runs that could be recorded. Nodes: {', '.join(self.order)}")

    def drive(self, gs: GraphState, tables: Tables, replayed: Mapping[str, PyTree], step: Step) -> PyTree:
        """Run the world's ticks with ``step`` in place of the world's own step, such as physics outside of JAX.

        Args:
            step: Maps the world's step state to the next one and to a result.

        Returns:
            The results, leaves ``(ticks, ...)``.
        """
        if self.world is None:
            raise UsageError("drive() is for graphs with a world, this one has none")
        world, senders = self.world, [c.output_node.name for c in self.nodes[self.world].inputs.values()]
        if live := [n for n in senders if n not in replayed]:
            raise UsageError(
                f"drive() needs all messages that the world {world!r} hears, and {live[0]!r} is not given",
                hint="give its recorded outputs",
            )
        sent = {n: _with_default(gs.aux[OUTPUTS][n], rows) for n, rows in replayed.items()}
        return self._scan(world, gs, tables[world], sent, step, ahead=True)

    def _scan(
        self, name: str, gs: GraphState, table: Tables, sent: Mapping[str, PyTree], step: Step, ahead: bool = False
    ) -> PyTree:
        """Make all steps of a node; ``ahead`` looks up the messages of all steps before the first step."""

        def one(carry: PyTree, now: Tables) -> tuple[PyTree, PyTree]:
            rng, state, params = carry
            inputs = now["inputs"] if ahead else self._inputs(name, gs, now, sent)
            new, output = step(StepState(rng, state, params, inputs, gs.eps, now["seq"], now["ts"]))
            state = matched(name, "the state that step returns", new.state, "the one it got", state)
            params = matched(name, "the params that step returns", new.params, "the ones it got", params)
            return (new.rng, state, params), output

        if ahead:
            table = {**table, "inputs": jax.vmap(lambda now: self._inputs(name, gs, now, sent))(table)}
        return jax.lax.scan(one, (gs.rng[name], gs.state[name], gs.params[name]), table)[1]

    def _step_of(self, name: str, gs: GraphState) -> Step:
        """Return a node's step, with its output in the form of its default output."""

        def step(step_state: StepState) -> tuple[StepState, PyTree]:
            try:
                new, output = self.nodes[name].step(step_state)
            except Exception as error:
                error.add_note(f"in the step of node {name!r}")
                raise
            return new, matched(name, "the output of step", output, "that of init_output", gs.aux[OUTPUTS][name])

        return step

    def _inputs(self, name: str, gs: GraphState, now: Tables, sent: Mapping[str, PyTree]) -> dict[str, InputState]:
        """Return the inputs of one step."""
        node, inputs = self.nodes[name], {}
        for input_name, t in now["inputs"].items():
            connection = node.inputs[input_name]
            data = pytree.map(lambda leaf, t=t: leaf[t["seq"] + 1], sent[connection.output_node.name])
            state = InputState(t["seq"], t["sent"], t["received"], data)
            dist = gs.delays.get(name, {}).get(input_name)
            if dist is not None:
                period_s = 1.0 / node.rate
                delayed = dist.apply(state, t["lead"], connection.window, period_s, now["ts"], connection.skip)
                state = delayed.replace(delay_dist=dist)
            inputs[input_name] = state
        return inputs


def _with_default(default: PyTree, rows: PyTree) -> PyTree:
    """Return messages ``(N, ...)`` behind the default output: message k is at place k + 1, an empty slot at place 0."""
    return pytree.map(lambda first, rest: jnp.concatenate([first[None], jnp.asarray(rest)]), default, rows)


def _window(nodes: Mapping[str, BaseNode], timeline: Timeline, name: str, input_name: str, seq: np.ndarray) -> Tables:
    """Return the messages in the window of every step ``seq (E, K)`` of a node, leaves ``(E, K, W)``."""
    edge, reader = timeline.edges[name, input_name], timeline.vertices[name]
    width = nodes[name].inputs[input_name].total_window
    newest = np.where(seq >= 0, newest_message(edge, reader), -1)
    read = messages_read(width, newest, reader.start, edge, timeline.vertices[edge.sender])
    return dict(zip(("seq", "sent", "received", "lead"), read, strict=True))
