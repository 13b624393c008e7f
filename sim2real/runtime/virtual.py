"""A clock whose time passes only while every thread of a graph waits: for emulated robots in the same process."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

from sim2real.errors import Sim2RealError
from sim2real.runtime.clock import MonotonicClock

_HANGS_S: Final = 120.0
"""Longest time for which a thread may compute without waiting [s], on the machine's clock."""
_INTERRUPTED_HANGS_S: Final = 2.0
"""Longest time for which a thread may compute after Ctrl-C [s]."""


class Time(Protocol):
    """The time of an emulated robot."""

    def now_ns(self) -> int:
        """Return the time [ns]."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Let time pass [s]."""
        ...


@dataclass
class _Waiting:
    """A thread that waits until its predicate is true, at most until its deadline [ns]."""

    predicate: Callable[[], Any]
    deadline: float
    wake: threading.Condition


class VirtualClock(MonotonicClock):
    """The clock of an emulated robot, for the graph that drives it.

    The threads of the graph, and the thread that makes this clock, take turns: one runs until it waits or ends; then
    the thread whose deadline comes first runs. When all wait, time jumps to that deadline. Computing takes no time, so
    episodes are equal on every machine and in every repetition.
    """

    def __init__(self, time: Time) -> None:
        self._time = time
        self._mutex = threading.RLock()
        self._turn: threading.Thread | None = threading.current_thread()  # None: it ended while no other waited
        self._waiting: dict[threading.Thread, _Waiting] = {}
        self._hangs = False
        super().__init__()

    def monotonic_ns(self) -> int:
        return self._time.now_ns()

    def keep_time(self) -> None:
        """Take no priority: these threads keep no time."""

    def start(self, thread: threading.Thread) -> None:
        run, waiting = thread.run, self._wait(lambda: True, 0.0)

        def take_part() -> None:
            self._await_turn(thread, waiting)
            try:
                run()
            finally:
                self._pass_on(thread)

        thread.run = take_part
        self._waiting[thread] = waiting
        thread.start()

    def wait_for(self, predicate: Callable[[], Any], timeout_s: float | None = None) -> bool:
        """Wait until a predicate is true; return whether it became so before the timeout."""
        if not (predicate() or self._hangs):
            deadline = float("inf") if timeout_s is None else self.monotonic_ns() + round(1e9 * max(0.0, timeout_s))
            me = threading.current_thread()
            self._waiting[me] = waiting = self._wait(predicate, deadline)
            self._await_turn(me, waiting)
        return bool(predicate())

    def event(self) -> Any:
        return _Event(self)

    def condition(self) -> Any:
        return _Condition(self)

    def lock(self) -> Any:
        return _Lock(self)

    def _wait(self, predicate: Callable[[], Any], deadline: float) -> _Waiting:
        return _Waiting(predicate, deadline, threading.Condition(self._mutex))

    def _await_turn(self, me: threading.Thread, waiting: _Waiting) -> None:
        """Pass the turn on, and return when this thread has it again, or when another thread hangs."""
        has_turn = lambda: self._turn is me or self._hangs  # noqa: E731
        with self._mutex:
            try:
                self._pass_on(me)
                if not waiting.wake.wait_for(has_turn, _HANGS_S):
                    self._hangs = True
            except BaseException:
                # After Ctrl-C this thread goes on once the running thread waits.
                waiting.predicate = lambda: True
                if not waiting.wake.wait_for(has_turn, _INTERRUPTED_HANGS_S):
                    self._hangs = True
                raise
            finally:
                del self._waiting[me]
                if self._hangs:  # no thread waits for its turn any more; the graph's watchdog finds the one that hangs
                    for other in self._waiting.values():
                        other.wake.notify()

    def _pass_on(self, me: threading.Thread) -> None:
        """Pass this thread's turn to the thread whose deadline comes first, and let time pass until then."""
        with self._mutex:
            if self._turn is me and not self._waiting:
                self._turn = None
            while self._turn in (me, None) and self._waiting:
                now = self.monotonic_ns()
                ready = [t for t, w in self._waiting.items() if w.deadline <= now or w.predicate()]
                if ready:
                    self._turn = min(ready, key=lambda thread: self._waiting[thread].deadline)
                    self._waiting[self._turn].wake.notify()
                    return
                deadline = min(w.deadline for w in self._waiting.values())
                if deadline == float("inf"):
                    raise Sim2RealError(
                        f"every thread waits, none has a deadline: {', '.join(t.name for t in self._waiting)}"
                    )
                self._time.sleep(1e-9 * (deadline - now))


class _Condition:
    """A condition variable without lock and notification: only one thread runs at a time."""

    def __init__(self, clock: VirtualClock) -> None:
        self.wait_for = clock.wait_for

    def __enter__(self) -> None: ...

    def __exit__(self, *error: object) -> None: ...

    def notify(self) -> None: ...

    notify_all = notify


class _Event:
    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self._flag = clock, False

    def is_set(self) -> bool:
        return self._flag

    def set(self) -> None:
        self._flag = True

    def wait(self, timeout: float | None = None) -> bool:
        return self._clock.wait_for(self.is_set, timeout)


class _Lock:
    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self._held = clock, False

    def __enter__(self) -> None:
        self._clock.wait_for(lambda: not self._held)
        self._held = True

    def __exit__(self, *error: object) -> None:
        self._held = False
