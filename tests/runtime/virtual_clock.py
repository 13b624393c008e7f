"""Virtual time for graphs on the wall clock: it jumps to the next deadline when every thread waits."""

import threading

from sim2real.runtime.clock import MonotonicClock


class VirtualClock(MonotonicClock):
    """A clock that shows the time of the wall clock's threads without letting it pass.

    All threads that exist while a test runs take part, except those that existed before. Computing takes no time:
    only ``sleep`` and waiting do.
    """

    def __init__(self):
        self._ns = 1_000_000_000_000
        self._lock = threading.RLock()
        self._waiting = {}  # thread -> (predicate, deadline [ns], what wakes it)
        self._others = set(threading.enumerate()) - {threading.current_thread()}
        super().__init__()

    def monotonic_ns(self):
        return self._ns

    def keep_time(self):
        """Take no priority: these threads keep no time."""

    def sleep(self, seconds):
        self.wait_for(lambda: False, seconds)

    def wait_for(self, predicate, timeout_s=None):
        """Wait until a predicate is true; return whether it became so before the timeout."""
        me = threading.current_thread()
        with self._lock:
            deadline = float("inf") if timeout_s is None else self.monotonic_ns() + round(1e9 * max(0.0, timeout_s))
            wake = threading.Condition(self._lock)
            self._waiting[me] = predicate, deadline, wake
            try:
                while not (found := predicate()) and self.monotonic_ns() < deadline:
                    if not self._jump():
                        wake.wait(0.001)  # a thread that ends wakes nobody
                return bool(found)
            finally:
                del self._waiting[me]

    def event(self):
        return _Event(self)

    def condition(self):
        return _Condition(self)

    def lock(self):
        return _Lock(self)

    def taking_part(self):
        """Return the threads for which time waits."""
        return set(threading.enumerate()) - self._others

    def _jump(self):
        """Go to the next deadline if all threads wait for one; return whether the time has changed."""
        taking_part = self.taking_part()
        if not taking_part <= self._waiting.keys():
            return False
        deadline = min(deadline for _, deadline, _ in self._waiting.values())
        if deadline <= self.monotonic_ns() or any(predicate() for predicate, *_ in self._waiting.values()):
            return False
        assert deadline < float("inf"), f"all wait for ever: {[t.name for t in taking_part]}"
        self._go_to(deadline)
        self._wake()
        return True

    def _wake(self):
        """Wake the threads whose time has come; the others would only look and wait on."""
        for predicate, deadline, wake in self._waiting.values():
            if deadline <= self.monotonic_ns() or predicate():
                wake.notify()

    def _go_to(self, deadline):
        self._ns = deadline


class _Condition:
    def __init__(self, clock):
        self._clock = clock
        self.wait_for = clock.wait_for
        self.notify = self.notify_all = lambda n=1: clock._wake()

    def __enter__(self):
        return self._clock._lock.__enter__()

    def __exit__(self, *error):
        return self._clock._lock.__exit__(*error)


class _Event(_Condition):
    def __init__(self, clock):
        super().__init__(clock)
        self._flag = False

    def is_set(self):
        return self._flag

    def set(self):
        with self:
            self._flag = True
            self.notify_all()

    def wait(self, timeout=None):
        return self.wait_for(self.is_set, timeout)


class _Lock:
    def __init__(self, clock):
        self._clock, self._held = clock, False

    def __enter__(self):
        with self._clock._lock:
            self._clock.wait_for(lambda: not self._held)
            self._held = True

    def __exit__(self, *error):
        with self._clock._lock:
            self._held = False
            self._clock._wake()
