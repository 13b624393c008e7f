"""The order of nodes in a picture, their colours, and the longest of their periods."""

import math
import re
from collections.abc import Mapping

import numpy as np

from sim2real.graph.episode import Episode


def in_order(episode: Episode) -> list[str]:
    """Return the nodes' names: first those with an ``order``, then the others, senders before readers if possible."""
    senders: Mapping[str, set[str]] = {
        n: {i["from"] for i in node.get("inputs", {}).values()} for n, node in episode.metadata.get("graph", {}).items()
    }
    order: list[str] = []
    remaining = list(episode.steps)
    while remaining:
        ready = [n for n in remaining if not (senders.get(n, set()) & set(remaining) - {n})] or remaining
        order.append(ready[0])
        remaining.remove(ready[0])
    orders = {n: node.get("order") for n, node in episode.metadata.get("graph", {}).items()}
    place = {n: orders[n] if isinstance(orders.get(n), int) else math.inf for n in order}
    return sorted(order, key=lambda n: place[n])  # a stable sort


def color_of(episode: Episode, node: str, default: str) -> str:
    """Return a node's colour as ``#rrggbb``.

    Args:
        default: Returned if the node has no valid colour.
    """
    color = episode.metadata.get("graph", {}).get(node, {}).get("color")
    if not isinstance(color, str) or re.fullmatch("#[0-9a-f]{6}", color):
        return color or default
    from matplotlib.colors import is_color_like, to_hex  # knows the names of colours

    return to_hex(color) if is_color_like(color) else default


def slowest_period_s(episode: Episode) -> float:
    """Return the longest of the nodes' median periods [s]."""
    periods = [float(np.median(np.diff(s.start))) for s in episode.steps.values() if len(s) > 1]
    return max(periods, default=1e6 * episode.duration_s) / 1e6
