"""The clock of a device: the machine's monotonic clock, or the time of an emulated robot in the same process."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol


class Clock(Protocol):
    """The time of a device and of its watchdogs; `sleep` returns after a time [s]."""

    def now_ns(self) -> int: ...
    def sleep(self, duration_s: float) -> None: ...

    def repeat(self, call: Callable[[], None], period_s: float, done: threading.Event, name: str) -> None:
        """Call a function now and after every period until ``done`` is set, in parallel to the caller."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC; `repeat` runs in a thread."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def repeat(self, call: Callable[[], None], period_s: float, done: threading.Event, name: str) -> None:
        """Start a daemon thread with the priority of a control loop."""

        def run() -> None:
            with suppress(Exception):  # without the priority the thread is slower, but it runs
                from sim2real.runtime.clock import keep_time  # the emulators' processes do not need the runtime

                keep_time()
            while not done.is_set():
                call()
                done.wait(period_s)

        threading.Thread(target=run, name=name, daemon=True).start()


SYSTEM_CLOCK: Final = SystemClock()
