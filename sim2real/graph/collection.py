"""The nodes of a graph, by name."""

from collections.abc import Mapping, Sequence

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode


def by_name(nodes: Mapping[str, BaseNode] | Sequence[BaseNode]) -> dict[str, BaseNode]:
    """Return nodes as a dictionary by name, checked."""
    if not isinstance(nodes, Mapping | Sequence) or isinstance(nodes, str):
        raise UsageError(
            f"the nodes of a graph were expected, got {nodes!r}", hint="pass a list or a dictionary of them"
        )
    # Names are unique, and keys of a dictionary are the names.
    named: dict[str, BaseNode] = {}
    for key, node in nodes.items() if isinstance(nodes, Mapping) else ((None, node) for node in nodes):
        if not isinstance(node, BaseNode):
            raise UsageError(f"a graph is made of nodes, got {node!r}", hint="derive its class from BaseNode")
        if node.name in named:
            raise UsageError(f"two nodes are called {node.name!r}", hint="names are unique in a graph")
        if key not in (None, node.name):
            raise UsageError(f"the key {key!r} stands for a node that is called {node.name!r}")
        named[node.name] = node
    return named


def check_senders(nodes: Mapping[str, BaseNode], among: Mapping[str, object] | None = None) -> None:
    """Check that every sender is in the graph: the same object, not only a node of the same name.

    Args:
        among: Check only senders with these names, as others are missing on purpose; None: all senders.
    """
    for node in nodes.values():
        for c in node.inputs.values():
            sender, where = c.output_node, f"node {node.name!r} listens to"
            if among is not None and sender.name not in among:
                continue
            if sender.name not in nodes:
                raise UsageError(
                    f"{where} {sender.name!r}, which is not in the graph. Nodes: {', '.join(nodes)}",
                    hint="pass every node that another one listens to",
                )
            if nodes[sender.name] is not sender:
                raise UsageError(
                    f"{where} another object called {sender.name!r} ({sender!r}) than the one in the graph "
                    f"({nodes[sender.name]!r})",
                    hint=f"if {sender.name!r} was replaced, connect {node.name!r} to the new node",
                )
