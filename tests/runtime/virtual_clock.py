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
        self._gate = threading.Condition()
        self._waiting = {}  # thread -> (predicate, deadline [ns])
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
        with self._gate:
            deadline = float("inf") if timeout_s is None else self.monotonic_ns() + round(1e9 * max(0.0, timeout_s))
            self._waiting[me] = predicate, deadline
            try:
                while not (found := predicate()) and self.monotonic_ns() < deadline:
                    self._jump()
                    self._gate.wait(0.001)  # a thread that ends wakes nobody
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
        taking_part = self.taking_part()
        if not taking_part <= self._waiting.keys():
            return
        deadline = min(deadline for _, deadline in self._waiting.values())
        if deadline <= self.monotonic_ns() or any(predicate() for predicate, _ in self._waiting.values()):
            return
        assert deadline < float("inf"), f"all wait for ever: {[t.name for t in taking_part]}"
        self._go_to(deadline)
        self._gate.notify_all()

    def _go_to(self, deadline):
        self._ns = deadline


class _Condition:
    def __init__(self, clock):
        self._clock = clock
        self.wait_for = clock.wait_for
        self.notify = self.notify_all = lambda n=1: clock._gate.notify_all()

    def __enter__(self):
        return self._clock._gate.__enter__()

    def __exit__(self, *error):
        return self._clock._gate.__exit__(*error)


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
        with self._clock._gate:
            self._clock.wait_for(lambda: not self._held)
            self._held = True

    def __exit__(self, *error):
        with self._clock._gate:
            self._held = False
            self._clock._gate.notify_all()
