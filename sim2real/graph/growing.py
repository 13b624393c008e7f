"""Timelines without an end: more delays are drawn when a run reaches the end of the timeline."""

from collections.abc import Callable, Mapping

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode, phase_ticks, to_ticks
from sim2real.graph.schedule import computation_delays, derive, transport_delays
from sim2real.graph.timeline import Timeline

_FIRST_S = 4.0
"""Shortest length of the first timeline [s]; it holds at least two steps of the slowest node."""


class Growing:
    """Draws one episode, twice as long each time; earlier draws stay unchanged.

    Args:
        check: Called with each timeline before it is used.

    Attributes:
        ticks: Its length [ticks]; it has all steps that start earlier.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode],
        rng: np.random.Generator,
        check: Callable[[Mapping[str, BaseNode], Timeline], None],
    ) -> None:
        self._nodes, self._rng, self._check = nodes, rng, check
        slowest_s = max(phase_ticks(n) / 1e6 + 2.0 / n.rate for n in nodes.values())
        self._duration_s = max(_FIRST_S, 2.0 * slowest_s) / 2.0
        self._delays: dict[str, np.ndarray] = {}
        self._transfers: dict[tuple[str, str], np.ndarray] = {}
        self.timeline, self.ticks = Timeline({}, {}), 0
        self.grow()

    def grow(self) -> None:
        """Draw a timeline of twice the length that begins as the one so far."""
        self._duration_s *= 2.0
        if self._duration_s > 1e9:
            raise UsageError("an episode cannot last longer than 30 years")
        # Keep the delays of the first half, and draw those of the second.
        for name, node in self._nodes.items():
            earlier = self._delays.get(name, np.zeros((1, 0), np.int64))
            self._delays[name] = computation_delays(node, self._duration_s, 1, self._rng, earlier)
        for node in self._nodes.values():
            for c in node.inputs.values():
                count = self._delays[c.output_node.name].shape[1]
                earlier = self._transfers.get((node.name, c.name), np.zeros((1, 0), np.int64))
                self._transfers[node.name, c.name] = transport_delays(c, (1, count), self._rng, earlier)
        # Derive the longer timeline: its first half is the same.
        self.ticks = to_ticks(self._duration_s)
        self.timeline = derive(self._nodes, self._delays, self._transfers, self.ticks)
        self._check(self._nodes, self.timeline)
