"""Messages that come in bursts: after a hiccup, a node that returns to its grid makes several steps at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import overfull


def make_room(nodes: Mapping[str, BaseNode], timeline: Timeline) -> dict[tuple[str, str], int]:
    """Widen, in place, the windows with trainable delays that do not hold the bursts of a timeline.

    Without it such a timeline is refused (``sim2real.graph.windows.check_bursts``). A window that does hold them stays
    as it is, so a timeline without hiccups costs nothing.

    Returns:
        (node, input) -> how many messages the window grew by, where it did.
    """
    grown: dict[tuple[str, str], int] = {}
    for key, edge in timeline.edges.items():
        connection = nodes[key[0]].inputs[key[1]]
        reader, sender = timeline.vertices[key[0]], timeline.vertices[edge.sender]
        while isinstance(dist := connection.delay_dist, TrainableDist) and np.any(
            overfull(connection, edge, reader, sender)
        ):
            connection.delay_dist = dist.replace(burst=dist.burst + 1)  # pyright: ignore[reportAttributeAccessIssue]
            grown[key] = grown.get(key, 0) + 1
    return grown
