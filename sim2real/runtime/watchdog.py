"""Who looks after the threads of the nodes: a step that does not end, a startup that outlives the stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping

from sim2real.graph.node import BaseNode
from sim2real.runtime.failure import GraphTimeout
from sim2real.runtime.nodethread import NodeThread, Shared

LEAST_S, PERIODS = 1.0, 10.0
"""By default a step hangs after so many of its node's periods, but not before so many seconds: a busy laptop may well
hold a step up for a few hundred milliseconds."""
LAST_RESORT_S = 1.0
"""How long a call of a node's ``stop`` from outside may take before nobody waits for it any more [s]."""
_GRACE_S = 0.2
"""A startup that still runs so long after the graph was stopped is not waited for [s]."""


def step_limits(nodes: Mapping[str, BaseNode], limit_s: float | None) -> dict[str, float]:
    """Return how long a step of each node may take [s]: ``limit_s`` for all, 0 for ever, None for the default."""
    if limit_s is None:
        return {name: max(LEAST_S, PERIODS / node.rate) for name, node in nodes.items()}
    return dict.fromkeys(nodes, limit_s or float("inf"))


class Watchdog(threading.Thread):
    """Fails the graph when a step takes too long, and makes a node safe whose own thread cannot.

    Args:
        threads: The threads of the nodes.
        limits: How long a step of each may take [s], by name.
        shared: What all threads share.
    """

    def __init__(self, threads: Iterable[NodeThread], limits: Mapping[str, float], shared: Shared) -> None:
        super().__init__(name="sim2real:watchdog of the graph", daemon=True)
        self._threads, self._limits, self._shared = list(threads), limits, shared
        self._quit = threading.Event()

    def run(self) -> None:
        """Look whenever a thread that runs now, or starts to run now, could have run for too long."""
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
        """End: the graph has stopped, and its threads have ended or have had their time."""
        self._quit.set()
        if self.ident is not None:
            self.join()

    def _look(self, thread: NodeThread, now: float, stopped_s: float) -> float:
        """Deal with a thread that has run too long; return how long it, or what it does next, may run [s]."""
        limit = self._limits[thread.node.name]
        since, during = thread.since_s, thread.during
        if since is None:
            return limit
        if during == "startup" and not stopped_s:
            return limit  # it has a timeout of its own
        rest = stopped_s + _GRACE_S - now if during == "startup" else since + limit - now
        if rest > 0 or thread.since_s != since:
            return rest
        if not stopped_s:
            thread.failed = True
            self._shared.fail(
                GraphTimeout(
                    f"node {thread.node.name!r} hangs: its {during} has taken {limit:g} s, so the graph stopped",
                    hint="give what it waits for a timeout of its own, or AsyncGraph a longer step_timeout_s",
                )
            )
        thread.make_safe_from_outside(LAST_RESORT_S)
        if during != "startup":  # which may well come back, and then stops by itself
            thread.over.set()
        return limit
