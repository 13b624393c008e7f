"""The initial state of a graph; the same key gives the same state in every runtime."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.collection import by_name, check_senders
from sim2real.graph.node import BaseNode, phase_ticks
from sim2real.graph.rules import waits_for_schedule
from sim2real.runtime.compilation.bounds import DelayBounds, bounds_of

OUTPUTS = "outputs"
"""Key in ``GraphState.aux`` of the default outputs by node name; each is drawn once and shared by all readers."""


def collect(nodes: Mapping[str, BaseNode] | Sequence[BaseNode], supervisor: BaseNode) -> dict[str, BaseNode]:
    """Return the nodes by name, with the supervisor, after checking that they form a graph.

    Raises:
        UsageError: When two nodes have the same name, a sender is missing, connections that are not skipped form a
            loop, or ``advance`` is set for a node without a blocking input.
    """
    if not isinstance(supervisor, BaseNode):
        raise UsageError(f"the supervisor is one node, got {supervisor!r}", hint="pass the node itself, not its name")
    found = by_name(nodes)
    found = found if found.get(supervisor.name) is supervisor else by_name([*found.values(), supervisor])
    check_senders(found)
    for node in found.values():
        phase_ticks(node)
        waits_for_schedule(node)
    return found


T = TypeVar("T")


def init_graph_state(
    nodes: Mapping[str, BaseNode],
    supervisor: BaseNode | str,
    rng: jax.Array,
    params: Mapping[str, Any] | None = None,
    order: Sequence[str] | None = None,
    bounds: DelayBounds | None = None,
) -> GraphState:
    """Return the state in which a graph starts; a pure function that can be traced and mapped.

    The parameters of all nodes are made first, then their states, their default outputs (``aux["outputs"]``) and their
    trainable delays; each ``init_*`` method gets the graph state with everything made so far. A node's keys depend on
    ``rng`` and its name alone.

    Args:
        nodes: The nodes by name; their senders may be left out.
        supervisor: The supervisor, or its name.
        params: Parameters that are used as given; for nodes without an entry ``init_params`` is called.
        order: Names of nodes that are initialised first; then comes the supervisor, then the others.
        bounds: Those of the trainable delays; None: as the connections have them.

    Raises:
        UsageError: When ``supervisor``, ``params`` or ``order`` names an unknown node.
    """
    first = supervisor if isinstance(supervisor, str) else supervisor.name
    names = _order(nodes, first, params or {}, order or ())
    keys = {n: jax.random.split(jax.random.fold_in(rng, jnp.uint32(zlib.crc32(n.encode()))), 5) for n in nodes}
    state = GraphState(
        eps=jnp.int32(0),
        step=jnp.int32(-1),
        rng={n: keys[n][0] for n in nodes},
        params={n: _fixed(nodes[n], p) for n, p in (params or {}).items()},
        seq={n: jnp.int32(0) for n in nodes},
    )
    for n in names:
        if n not in state.params:
            made = _fixed(nodes[n], nodes[n].init_params(keys[n][1], state))
            state = state.replace(params={**state.params, n: made})
    for n in names:
        made = _fixed(nodes[n], nodes[n].init_state(keys[n][2], state))
        state = state.replace(state={**state.state, n: made})
    outputs = {n: jax.tree_util.tree_map(_strong, nodes[n].init_output(keys[n][3], state)) for n in names}
    state = state.replace(aux={**state.aux, OUTPUTS: outputs})
    return state.replace(delays={n: d for n in names if (d := _delays(nodes[n], keys[n][4], state, bounds))})


def default_output(graph_state: GraphState, node: str) -> Any:
    """Return a node's default output: the message in its readers' windows before its first message arrives."""
    outputs = graph_state.aux.get(OUTPUTS, {})
    if node not in outputs:
        raise UsageError(f"the graph state has no default output of {node!r}", hint="make graph states with init()")
    return outputs[node]


def _order(
    nodes: Mapping[str, BaseNode], supervisor: str, params: Mapping[str, Any], order: Sequence[str]
) -> list[str]:
    for what, given in (("supervisor", [supervisor]), ("params", params), ("order", order)):
        unknown = [n for n in given if n not in nodes]
        if unknown:
            raise UsageError(f"{what} names {', '.join(unknown)}, not in the graph. Nodes: {', '.join(nodes)}")
    return list(dict.fromkeys([*order, supervisor, *nodes]))


def _delays(node: BaseNode, key: jax.Array, state: GraphState, bounds: DelayBounds | None) -> dict[str, Any]:
    """Return the distributions of a node's trainable inputs, at the delays that ``init_delays`` gives."""
    own = (bounds or bounds_of({node.name: node})).get(node.name, {})
    given = node.init_delays(key, state) if own else {}
    dists: dict[str, Any] = {n: c.delay_dist for n, c in node.inputs.items()}
    return {n: b.at(dists[n], given.get(n)) for n, b in own.items()}


def _fixed(node: BaseNode, tree: T) -> T:
    """Return arrays without JAX's weak types; a node in plain Python keeps its own objects."""
    return jax.tree_util.tree_map(_strong, tree) if node.jittable else tree


def _strong(leaf: Any) -> Any:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return jnp.asarray(leaf, dtype=jnp.result_type(leaf))
