"""Windows for messages that come in bursts, e.g. when a node catches up with its grid after a hiccup."""

from collections.abc import Mapping

import numpy as np

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import overfull


def make_room(nodes: Mapping[str, BaseNode], timeline: Timeline) -> dict[tuple[str, str], int]:
    """Lengthen, in place, the windows with a trainable delay that are too short for the bursts of a timeline.

    Otherwise ``sim2real.graph.windows.check_bursts`` refuses such a timeline.

    Returns:
        (node, input) -> number of messages that were added to the window, for the windows that were too short.
    """
    grown: dict[tuple[str, str], int] = {}
    for key, edge in timeline.edges.items():
        connection = nodes[key[0]].inputs[key[1]]
        reader, sender = timeline.vertices[key[0]], timeline.vertices[edge.sender]
        while isinstance(dist := connection.delay_dist, TrainableDist) and np.any(
            overfull(connection, edge, reader, sender)
        ):
            connection.delay_dist = dist.replace(burst=dist.burst + 1)
            grown[key] = grown.get(key, 0) + 1
    return grown
