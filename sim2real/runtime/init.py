"""The initial state of a graph; the same key gives the same state in every runtime."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, by_name, check_senders, phase_ticks
from sim2real.graph.rules import waits_for_schedule
from sim2real.installation import has_jax
from sim2real.later import jax, jnp
from sim2real.types import Array, PyTree

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from sim2real.graph.base import Number

OUTPUTS = "outputs"
"""Key in ``GraphState.aux`` of the default outputs by node name; each is drawn once and shared by all readers."""


class Bounds(NamedTuple):
    """The numbers of a ``TrainableDist``, each of shape ``()``.

    Attributes:
        low: Smallest delay [s].
        span: Largest delay minus the smallest [s].
        alpha: Position of the delay between the bounds, in [0, 1].
    """

    low: Number
    span: Number
    alpha: Number

    def at(self, dist: TrainableDist, delay: Number | None) -> TrainableDist:
        """Return a distribution at a delay [s], clipped to these bounds; None: at ``alpha``."""
        if delay is None:
            return dist.replace(alpha=jnp.asarray(self.alpha))
        alpha = (jnp.asarray(delay, jnp.float32) - self.low) / self.span
        return dist.replace(alpha=jnp.clip(alpha, 0.0, 1.0))

    def opened(self, dist: TrainableDist) -> TrainableDist:
        """Return a distribution with the same delay and the bounds 0 and 1 s, which all programs share."""
        return dist.replace(alpha=self.low + dist.alpha * self.span, min=0.0, max=1.0)


DelayBounds = Mapping[str, Mapping[str, Bounds]]
"""Node -> input -> the bounds of its trainable delay."""


def bounds_of(nodes: Mapping[str, BaseNode]) -> dict[str, dict[str, Bounds]]:
    """Return the bounds of all trainable delays."""
    bounds: dict[str, dict[str, Bounds]] = {}
    for name, node in nodes.items():
        for input_name, connection in node.inputs.items():
            if isinstance(dist := connection.delay_dist, TrainableDist):
                numbers = (np.float32(dist.min), np.float32(dist.max - dist.min), dist.alpha)
                bounds.setdefault(name, {})[input_name] = Bounds(*numbers)
    return bounds


def collect(nodes: Mapping[str, BaseNode] | Sequence[BaseNode], supervisor: BaseNode) -> dict[str, BaseNode]:
    """Return the nodes by name, with the supervisor, after checking that they form a graph.

    Raises:
        UsageError: Two nodes have the same name, a sender is missing, connections that are not skipped form a loop, or
            ``advance`` is set for a node without a blocking input.
    """
    if not isinstance(supervisor, BaseNode):
        raise UsageError(
            f"the supervisor must be one of the nodes, not {supervisor!r}", hint="pass the node, not its name"
        )
    graph = by_name(nodes)
    graph = graph if graph.get(supervisor.name) is supervisor else by_name([*graph.values(), supervisor])
    check_senders(graph)
    for node in graph.values():
        phase_ticks(node)
        waits_for_schedule(node)
    return graph


T = TypeVar("T")


def init_graph_state(
    nodes: Mapping[str, BaseNode],
    supervisor: BaseNode | str,
    rng: jax.Array | None,
    params: Mapping[str, PyTree] | None = None,
    order: Sequence[str] | None = None,
    bounds: DelayBounds | None = None,
) -> GraphState:
    """Return the state in which a graph starts; a pure function that can be traced and mapped.

    Each ``init_*`` method gets the graph state that is filled so far. A node's keys depend only on ``rng`` and its
    name.

    Args:
        rng: JAX's key; None: no node gets random numbers.
        params: Parameters to use; for nodes without an entry ``init_params`` is called.
        order: Names of nodes that are initialised first; then comes the supervisor, then the others.
        bounds: Bounds of the trainable delays; None: those of the connections.

    Raises:
        UsageError: ``supervisor``, ``params`` or ``order`` names an unknown node.
    """
    # Order the nodes, and derive the keys.
    first = supervisor if isinstance(supervisor, str) else supervisor.name
    names = _order(nodes, first, params or {}, order or ())
    keys = {n: _keys(rng, n) for n in nodes}
    state = GraphState(
        eps=_strong(np.int32(0)),
        step=_strong(np.int32(-1)),
        rng={n: keys[n][0] for n in nodes},
        params={n: _fixed(nodes[n], p) for n, p in (params or {}).items()},
        seq={n: _strong(np.int32(0)) for n in nodes},
    )

    # Parameters of all nodes, then their states, default outputs and trainable delays.
    for n in names:
        if n not in state.params:
            node_params = _fixed(nodes[n], nodes[n].init_params(keys[n][1], state))
            state = state.replace(params={**state.params, n: node_params})
    for n in names:
        node_state = _fixed(nodes[n], nodes[n].init_state(keys[n][2], state))
        state = state.replace(state={**state.state, n: node_state})
    outputs = {n: pytree.map(_strong, nodes[n].init_output(keys[n][3], state)) for n in names}
    state = state.replace(aux={**state.aux, OUTPUTS: outputs})
    return state.replace(delays={n: d for n in names if (d := _delays(nodes[n], keys[n][4], state, bounds))})


def key_numbers(key: PyTree) -> list[int]:
    """Return the numbers of a node's key; none without a key."""
    if key is None:
        return []
    data = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    return np.asarray(data).ravel().tolist()


def default_output(graph_state: GraphState, node: str) -> PyTree:
    """Return a node's default output: the message in its readers' windows before its first message arrives."""
    outputs = graph_state.aux.get(OUTPUTS, {})
    if node not in outputs:
        raise UsageError(f"the graph state has no default output of {node!r}", hint="make graph states with init()")
    return outputs[node]


def _order(
    nodes: Mapping[str, BaseNode], supervisor: str, params: Mapping[str, PyTree], order: Sequence[str]
) -> list[str]:
    for argument, names in (("supervisor", [supervisor]), ("params", params), ("order", order)):
        unknown = [n for n in names if n not in nodes]
        if unknown:
            raise UsageError(f"{argument} names {', '.join(unknown)}, not in the graph. Nodes: {', '.join(nodes)}")
    return list(dict.fromkeys([*order, supervisor, *nodes]))


def _keys(rng: jax.Array | None, node: str) -> PyTree:
    """Return the keys of a node: one for its steps, four for its start."""
    if rng is None:
        return [None] * 5
    return jax.random.split(jax.random.fold_in(rng, jnp.uint32(zlib.crc32(node.encode()))), 5)


def _delays(node: BaseNode, key: PyTree, state: GraphState, bounds: DelayBounds | None) -> dict[str, TrainableDist]:
    """Return the distributions of a node's trainable inputs, at the delays that ``init_delays`` returns."""
    of_node = (bounds or bounds_of({node.name: node})).get(node.name, {})
    delays = node.init_delays(key, state) if of_node else {}
    dists = {n: c.delay_dist for n, c in node.inputs.items()}
    return {n: b.at(d, delays.get(n)) for n, b in of_node.items() if isinstance(d := dists[n], TrainableDist)}


def _fixed(node: BaseNode, tree: T) -> T:
    """Return arrays without JAX's weak types; the objects of a node in plain Python stay unchanged."""
    return pytree.map(_strong, tree) if node.jittable else tree


def _strong(leaf: ArrayLike) -> Array:
    if not has_jax():
        return np.asarray(leaf)
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return jnp.asarray(leaf, dtype=jnp.result_type(leaf))
