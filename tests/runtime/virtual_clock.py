"""A clock of graphs whose time passes only while every thread waits: that of emulated robots, without a robot."""

from sim2real.runtime import virtual


class Time:
    """Time that is nothing else."""

    ns = 1_000_000_000_000

    def now_ns(self):
        return self.ns

    def sleep(self, duration_s):
        self.ns += round(1e9 * duration_s)


class VirtualClock(virtual.VirtualClock):
    """A virtual clock that knows which of the threads that it started run."""

    def __init__(self):
        self.running = set()
        super().__init__(Time())

    def sleep(self, seconds):
        self.wait_for(lambda: False, seconds)

    def start(self, thread):
        run = thread.run

        def counted():
            try:
                run()
            finally:
                self.running.discard(thread)

        thread.run = counted
        self.running.add(thread)
        super().start(thread)
