"""Checks that nodes and timeline fit each other and can be compiled."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode, by_name, check_senders
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import NEVER
from sim2real.types import PyTree


def nodes_of(nodes: Mapping[str, BaseNode] | Sequence[BaseNode], timeline: Timeline) -> dict[str, BaseNode]:
    """Return the nodes of a timeline by name."""
    named = by_name(nodes)
    missing = [n for n in timeline.vertices if n not in named]
    if missing:
        raise UsageError(f"the timeline holds node {missing[0]!r}, which was not given. Nodes: {', '.join(named)}")
    return {n: node for n, node in named.items() if n in timeline.vertices}


def supervisor_of(supervisor: BaseNode | str, nodes: Mapping[str, BaseNode]) -> str:
    """Return the supervisor's name; ``supervisor`` is the name or the node."""
    if not isinstance(supervisor, str | BaseNode):
        raise UsageError(f"the supervisor is one node, or its name, got {supervisor!r}")
    if isinstance(supervisor, BaseNode) and nodes.get(supervisor.name, supervisor) is not supervisor:
        raise UsageError(f"the supervisor {supervisor!r} is another object than the node of its name in the graph")
    return supervisor if isinstance(supervisor, str) else supervisor.name


def check_fit(nodes: Mapping[str, BaseNode], timeline: Timeline, replayed: Mapping[str, PyTree]) -> None:
    """Check that nodes, connections and timeline fit each other, and that the nodes can be compiled.

    Args:
        replayed: Recorded outputs of nodes that do not run: node -> leaves ``(E, N, ...)``.
    """
    # Nodes, and recorded outputs.
    for name, node in nodes.items():
        if not node.jittable and name not in replayed:
            raise UsageError(
                f"node {name!r} steps in plain Python (jittable = False) and cannot be compiled",
                hint="give its recorded outputs, or put a simulated node in its place",
            )
    check_senders(nodes, among=nodes)
    unknown = [n for n in replayed if n not in nodes]
    if unknown:
        raise UsageError(
            f"the outputs of {unknown[0]!r} are given, which is not in the graph. Nodes: {', '.join(nodes)}"
        )
    for name, recorded in replayed.items():
        _check_replayed(name, recorded, timeline)

    # Every input of a node has messages in the timeline, and the reverse.
    wanted = {(n, i) for n, node in nodes.items() for i, c in node.inputs.items() if c.output_node.name in nodes}
    for name, input_name in sorted(wanted - set(timeline.edges)):
        raise UsageError(
            f"the timeline has no messages for input {input_name!r} of node {name!r}",
            hint="draw them: sim2real.graph.schedule.draw(nodes, duration_s, recorded=timeline)",
        )
    for name, input_name in sorted(set(timeline.edges) - wanted):
        raise UsageError(
            f"the timeline has messages for input {input_name!r} of node {name!r}, which has no such input"
        )

    # Steps and messages are in the order of time.
    for name, vertex in timeline.vertices.items():
        if (np.diff(vertex.start, axis=1) < 0).any():
            raise UsageError(f"the steps of node {name!r} are not in the order of time")
    for (name, input_name), edge in timeline.edges.items():
        consumed = np.where(edge.seq_in < 0, NEVER, edge.seq_in)
        if edge.seq_in.shape != timeline.vertices[edge.sender].start.shape or (np.diff(consumed, axis=1) < 0).any():
            raise UsageError(
                f"the messages for input {input_name!r} of node {name!r} are not one for each step of {edge.sender!r}, "
                "consumed in order",
                hint="make timelines with draw() or Timeline.from_episode()",
            )


def _check_replayed(name: str, recorded: PyTree, timeline: Timeline) -> None:
    """Check that there is a recorded output for every step of every episode."""
    steps = int(timeline.vertices[name].count.max(initial=0))
    for path, leaf in pytree.flatten_with_path(recorded)[0]:
        shape = np.shape(leaf)
        if len(shape) < 2 or shape[0] != timeline.episodes or shape[1] < steps:
            raise UsageError(
                f"the given outputs of node {name!r}{''.join(map(str, path))} have shape {shape}: its timeline has "
                f"{timeline.episodes} episodes of up to {steps} steps",
                hint=f"give leaves of shape ({timeline.episodes}, {steps}, ...), an output for each step",
            )
