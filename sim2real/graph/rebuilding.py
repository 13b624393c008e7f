"""Replaces nodes of a graph; rates, delays and connections stay."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode, BaseWorld, by_name
from sim2real.types import PyTree

_TIMING = ("rate", "delay", "delay_dist", "advance", "scheduling")
_LOOKS = ("color", "order")


def rebuild(
    nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
    others: Mapping[str, Callable[..., BaseNode] | BaseNode | None],
    delays: Mapping[tuple[str, str], PyTree] | None = None,
) -> dict[str, BaseNode]:
    """Return new nodes with the rates, delays, scheduling and connections of a graph.

    Args:
        nodes: The nodes of the graph, by name or as a list; they stay unchanged.
        others: Node -> its replacement: a class or a function, called with the options of ``BaseNode`` that it takes
            (``functools.partial(SimSensor, outputs=recorded)`` adds further ones), or a node with its own timing. None
            removes the node and its connections. All other nodes are copied.
        delays: (reader, input) -> communication delay, such as a ``TrainableDist``, instead of the graph's.

    Raises:
        UsageError: A name is unknown, or a replacement does not fit.
    """
    # Copy or replace the nodes.
    old = by_name(nodes)
    _check_names(old, others, delays or {})
    new: dict[str, BaseNode] = {}
    for name, node in old.items():
        other = others.get(name, node)
        if other is not None:
            new[name] = _copied(node) if other is node else _replacement(node, other)

    # Connect them as before.
    for name in new:
        for c in old[name].inputs.values():
            if c.output_node.name not in new:
                continue
            changed = (delays or {}).get((name, c.name))
            delay, dist = (c.delay, c.delay_dist) if changed is None else (None, changed)
            sender = new[c.output_node.name]
            new[name].connect(sender, c.blocking, delay, dist, c.window, c.skip, c.jitter, c.name)
    return new


def _check_names(
    old: Mapping[str, BaseNode], others: Mapping[str, object], delays: Mapping[tuple[str, str], object]
) -> None:
    if unknown := [name for name in others if name not in old]:
        raise UsageError(f"the graph has no node {', '.join(map(repr, unknown))}. Nodes: {', '.join(old)}")
    inputs = [(name, i) for name, node in old.items() for i in node.inputs]
    if unknown := [key for key in delays if key not in inputs]:
        raise UsageError(f"the graph has no input {unknown[0]}. Inputs: {', '.join(map(str, inputs))}")


def _copied(node: BaseNode) -> BaseNode:
    new = copy.copy(node)
    new.inputs, new.outputs = {}, []
    new.set_clock(None)
    return new


def _replacement(old: BaseNode, other: Callable[..., BaseNode] | BaseNode) -> BaseNode:
    if isinstance(other, BaseNode):
        new = other
    else:
        options = {"name": old.name, **{n: getattr(old, n) for n in (*_TIMING, *_LOOKS)}}
        taken = inspect.signature(other).parameters
        # A world takes only its rate, so a replacement of a world gets no further options.
        open_ended = any(p.kind is p.VAR_KEYWORD for p in taken.values()) and not isinstance(old, BaseWorld)
        new = other(**{n: v for n, v in options.items() if n in taken or open_ended})
        if isinstance(new, BaseNode) and not isinstance(new, BaseWorld):
            for name in (*_TIMING, *_LOOKS):  # also options that its constructor does not take
                setattr(new, name, options[name])
    # Refuse a replacement that the connections do not fit.
    if not isinstance(new, BaseNode):
        raise UsageError(f"node {old.name!r}: a node was expected in its place, got {new!r}", hint="pass a class")
    if new.name != old.name:
        raise UsageError(f"node {old.name!r}: its replacement is called {new.name!r}", hint="keep the name")
    if new.inputs or new.outputs:
        raise UsageError(f"node {old.name!r}: its replacement is connected already", hint="pass a class")
    return new
