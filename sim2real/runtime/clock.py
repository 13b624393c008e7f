"""The clocks of a running graph, and interpreter settings for real time."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum

from sim2real.graph.node import TICKS_PER_S

_NS_PER_TICK = 1_000_000_000 // TICKS_PER_S
_SWITCH_INTERVAL_S = 0.00005
_PRIORITY, _GUARDIAN_PRIORITY = 1, 3
"""Real-time priorities of control threads, and of the guardian, which must never wait for them."""


class Clock(Enum):
    """The time base of a running graph."""

    SIMULATED = "simulated"
    """Delays are sampled; nodes step in the order of events, on one thread."""
    WALL_CLOCK = "wall_clock"
    """The machine's monotonic clock; every node has a thread."""


class MonotonicClock:
    """Ticks [us] since the episode's start, on the machine's monotonic clock; negative before it.

    The threads of a graph read the time and wait for each other through this class alone, so that ``VirtualClock`` can
    replace it for an emulated robot.
    """

    event, condition, lock = threading.Event, threading.Condition, threading.Lock

    def __init__(self) -> None:
        self.origin_ns = self.monotonic_ns()

    def monotonic_ns(self) -> int:
        """Return the machine's monotonic time [ns]."""
        return time.monotonic_ns()

    def monotonic_s(self) -> float:
        """Return the machine's monotonic time [s]."""
        return self.monotonic_ns() / 1e9

    def begin(self, lead_s: float) -> None:
        """Set time 0 to ``lead_s`` seconds from now, so that every thread sleeps before its first slot."""
        self.origin_ns = self.monotonic_ns() + int(lead_s * 1e9)

    def now(self) -> int:
        """Return the time [ticks]."""
        return (self.monotonic_ns() - self.origin_ns) // _NS_PER_TICK

    def now_s(self) -> float:
        """Return the time [s]."""
        return (self.monotonic_ns() - self.origin_ns) / 1e9

    def start(self, thread: threading.Thread) -> None:
        """Start a thread of the graph."""
        thread.start()

    def keep_time(self) -> None:
        """Give the calling thread a real-time priority; see the function ``keep_time``."""
        keep_time()

    def sleep_past(self, tick: int, stopping: threading.Event) -> bool:
        """Sleep until the clock shows more than ``tick``; return False if ``stopping`` was set meanwhile.

        "More", because a message that arrives while the clock shows ``tick`` belongs to a step that starts at ``tick``.
        """
        while (rest := tick + 1 - self.now()) > 0:
            if stopping.wait(rest / TICKS_PER_S):
                return False
        return not stopping.is_set()


def keep_time() -> None:
    """Give the calling thread a real-time priority, if the operating system allows it.

    Processes and threads that this one starts do not inherit the priority. On Linux it needs root, or a limit for
    real-time priorities (``ulimit -r``) of at least 3. Three nodes at 500 Hz beside an emulated bus on two processors:
    the 0.99 quantile of the lateness of wake-ups is 0.2 to 0.4 ms with the priority, 0.9 to 1.9 ms without.
    """
    with suppress(AttributeError, OSError):
        # The guardian needs a higher priority than this thread: if the system refuses that one, this thread takes none.
        for priority in (_GUARDIAN_PRIORITY, _PRIORITY):
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


_realtime_lock = threading.Lock()
_realtime_users = 0
_realtime_before: tuple[bool, float, bool] = (True, 0.005, False)


@contextmanager
def realtime() -> Iterator[None]:
    """Keep the interpreter from pausing control threads, in a ``with`` block around an episode on the wall clock.

    On entry the garbage collector runs once and is then switched off: reference cycles made inside the block are not
    freed before its end (the runtime's own steps make none). Objects alive at entry are frozen (``gc.freeze``). The
    interpreter's switch interval is 0.05 ms instead of 5 ms. All of this is restored when the last of nested blocks
    ends, except that objects stay frozen if the caller had frozen some before.
    """
    global _realtime_users, _realtime_before
    with _realtime_lock:
        # The outermost block changes the settings of the process.
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
            # The block that ends last restores them.
            _realtime_users -= 1
            if _realtime_users == 0:
                enabled, interval, frozen = _realtime_before
                if not frozen:
                    gc.unfreeze()
                if enabled:
                    gc.enable()
                sys.setswitchinterval(interval)
