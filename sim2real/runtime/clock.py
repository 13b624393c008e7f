"""Clocks of a running graph, and what a process does to keep to them."""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum

from sim2real.graph.node import TICKS_PER_S

_NS_PER_TICK = 1_000_000_000 // TICKS_PER_S
_SWITCH_INTERVAL_S = 0.0005


class Clock(Enum):
    """What moves a graph's time."""

    SIMULATED = "simulated"
    """Delays are sampled, nodes step in the order of events on one thread."""
    WALL_CLOCK = "wall_clock"
    """One thread a node, on the machine's monotonic clock."""


class MonotonicClock:
    """Ticks [us] since the episode's start, on the machine's monotonic clock; negative before it."""

    def __init__(self) -> None:
        self.origin_ns = time.monotonic_ns()

    def begin(self, lead_s: float) -> None:
        """Put time 0 ``lead_s`` ahead, so that every thread is asleep before its first slot."""
        self.origin_ns = time.monotonic_ns() + int(lead_s * 1e9)

    def now(self) -> int:
        """Return the time [ticks]."""
        return (time.monotonic_ns() - self.origin_ns) // _NS_PER_TICK

    def now_s(self) -> float:
        """Return the time [s]."""
        return (time.monotonic_ns() - self.origin_ns) / 1e9

    def sleep_past(self, tick: int, stopping: threading.Event, spin: int = 0) -> bool:
        """Sleep until the clock shows more than ``tick``; return False when ``stopping`` came first.

        More than, because a reader that looks while the clock still shows ``tick`` would miss a message stamped with
        that same tick an instant later, which by the rules is its own.

        Args:
            tick: When to wake [ticks].
            stopping: Ends the sleep at once.
            spin: Poll instead of sleeping for the last stretch [ticks].
        """
        while (rest := tick + 1 - spin - self.now()) > 0:
            if stopping.wait(rest / TICKS_PER_S):
                return False
        while self.now() <= tick:
            pass
        return not stopping.is_set()


_realtime_lock = threading.Lock()
_realtime_users = 0
_realtime_before: tuple[bool, float, bool] = (True, 0.005, False)


@contextmanager
def realtime() -> Iterator[None]:
    """Keep the interpreter from pausing control threads; wall-clock episodes enter it by themselves.

    The garbage collector runs once, what is alive is frozen, and collection is off until the exit: reference counting
    goes on, but cyclic garbage made meanwhile stays (a step as the runtime makes it leaves none). The interpreter
    offers the lock to waiting threads after 0.5 ms instead of 5 ms. The last exit restores both, unless the caller had
    frozen objects before: what is frozen then stays so.
    """
    global _realtime_users, _realtime_before
    with _realtime_lock:
        _realtime_users += 1
        if _realtime_users == 1:
            _realtime_before = (gc.isenabled(), sys.getswitchinterval(), gc.get_freeze_count() > 0)
            gc.collect()
            gc.freeze()
            gc.disable()
            sys.setswitchinterval(min(_SWITCH_INTERVAL_S, _realtime_before[1]))
    try:
        yield
    finally:
        with _realtime_lock:
            _realtime_users -= 1
            if _realtime_users == 0:
                enabled, interval, frozen = _realtime_before
                if not frozen:
                    gc.unfreeze()
                if enabled:
                    gc.enable()
                sys.setswitchinterval(interval)
