"""Watches the nodes' threads for a step that hangs, and for a startup that continues after the graph has stopped."""

import threading
import time
from collections.abc import Iterable, Mapping

from sim2real.graph.node import BaseNode
from sim2real.runtime.clock import keep_time
from sim2real.runtime.failure import GraphTimeout
from sim2real.runtime.wall_clock.node_thread import NodeThread, Shared

MIN_LIMIT_S, PERIODS = 1.0, 10.0
"""By default a step counts as hanging after ``PERIODS`` periods of its node, but not before ``MIN_LIMIT_S`` [s]: on a
busy laptop a step can be delayed by a few hundred milliseconds."""
LAST_RESORT_S = 1.0
"""Longest wait for a node's ``stop`` that another thread than the node's calls [s]."""
_GRACE_S = 0.2
"""Longest time of a startup after the graph was stopped, before the node's ``stop`` is called [s]."""


def step_limits(nodes: Mapping[str, BaseNode], limit_s: float | None) -> dict[str, float]:
    """Return the longest time of a step of each node [s].

    ``limit_s`` is the limit for all nodes; 0: no limit; None: the default, ten periods of the node but at least 1 s.
    """
    if limit_s is None:
        return {name: max(MIN_LIMIT_S, PERIODS / node.rate) for name, node in nodes.items()}
    return dict.fromkeys(nodes, limit_s or float("inf"))


class Watchdog(threading.Thread):
    """Stops the graph when a step takes too long, and calls ``stop`` of a node whose own thread is busy.

    Args:
        limits: Node name -> longest time of a step [s].
    """

    def __init__(self, threads: Iterable[NodeThread], limits: Mapping[str, float], shared: Shared) -> None:
        super().__init__(name="sim2real:watchdog of the graph", daemon=True)
        self._threads, self._limits, self._shared = list(threads), limits, shared
        self._quit = threading.Event()

    def run(self) -> None:
        """Check the threads; sleep between checks until the earliest time at which one could exceed its limit."""
        keep_time()
        shared, stopped_s = self._shared, 0.0
        while not self._quit.is_set():
            now = time.monotonic()
            if shared.stopping.is_set():
                stopped_s = stopped_s or now
            rests = [self._look(t, now, stopped_s) for t in self._threads if not t.made_safe]
            rest = max(0.0, min([*rests, *self._limits.values()]))
            waiting = self._quit if stopped_s else shared.stopping
            waiting.wait(min(rest, threading.TIMEOUT_MAX))

    def finish(self) -> None:
        """End the watchdog, after the graph has stopped."""
        self._quit.set()
        if self.ident is not None:
            self.join()

    def _look(self, thread: NodeThread, now: float, stopped_s: float) -> float:
        """Act if a thread has exceeded its limit; return the time until the next check [s]."""
        limit = self._limits[thread.node.name]
        since, during = thread.since_s, thread.during
        if since is None:
            return limit
        if during == "startup" and not stopped_s:
            return limit  # startups have their own timeout, in WallClockRun.begin
        # Time until the step, or the startup of a stopped graph, has taken too long.
        rest = stopped_s + _GRACE_S - now if during == "startup" else since + limit - now
        if rest > 0 or thread.since_s != since:
            return rest
        # Stop the graph, and make the node safe from outside of its thread.
        if not stopped_s:
            thread.failed = True
            self._shared.fail(
                GraphTimeout(
                    f"node {thread.node.name!r} hangs: its {during} has taken {limit:g} s, so the graph stopped",
                    hint="give its device or its wait a timeout, or AsyncGraph a longer step_timeout_s",
                )
            )
        thread.make_safe_from_outside(LAST_RESORT_S)
        if during != "startup":  # a startup may still end, after which its thread calls stop and ends
            thread.over.set()
        return limit
