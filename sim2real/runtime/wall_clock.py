"""A graph on the wall clock: starts and stops the nodes' threads, and watches them."""

import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from typing import NoReturn

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.episode import Recorder
from sim2real.graph.node import BaseNode
from sim2real.runtime.clock import MonotonicClock, realtime
from sim2real.runtime.failure import GraphTimeout
from sim2real.runtime.statistics import NodeStatistics
from sim2real.runtime.steps import NodeData, Reply, Stepper, snapshot
from sim2real.runtime.threads import Handover, MessageChannel, NodeThread, Shared

_LEAD_S = 0.005
_POLL_S = 0.05


class WallClockRun:
    """One episode on the wall clock.

    Args:
        recorder: Receives all steps and messages, or None.
        timeout_s: Longest wait of the supervisor for its caller [s].
        step_timeout_s: Longest time of a step [s]; see ``step_limits``.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode],
        supervisor: str,
        steppers: Mapping[str, Stepper],
        data: dict[str, NodeData],
        graph_state: GraphState,
        recorder: Recorder | None,
        autonomous: bool,
        clock: MonotonicClock,
        timeout_s: float,
        step_timeout_s: float | None,
    ) -> None:
        self._nodes, self._supervisor, self._data = nodes, supervisor, data
        self._graph_state, self._recorder, self._gym = graph_state, recorder, not autonomous
        self._clock = clock
        self._handover = Handover(autonomous, clock)
        self._shared = Shared(self._clock, recorder, graph_state, self._wake, timeout_s)
        self._channels = {(n, c.name): MessageChannel(c, self._clock) for n in nodes for c in nodes[n].inputs.values()}
        self._threads: dict[str, NodeThread] = {}
        for name, node in nodes.items():
            inputs = {i: self._channels[name, i] for i in node.inputs}
            outputs = [self._channels[c.input_node.name, c.name] for c in node.outputs if c.input_node.name in nodes]
            handover = self._handover if name == supervisor else None
            self._threads[name] = NodeThread(steppers[name], data[name], inputs, outputs, self._shared, handover)
        self._watchdog = Watchdog(self._threads.values(), step_limits(nodes, step_timeout_s), self._shared)
        self._process = ExitStack()
        self._stop_lock = clock.lock()
        self.stopped = False
        """Whether ``stop`` has ended all nodes, or told which one it could not end."""

    @property
    def ended(self) -> bool:
        """Whether the graph has stopped, or is stopping."""
        return self._shared.stopping.is_set()

    @property
    def alive(self) -> list[str]:
        """Nodes whose threads have not ended."""
        return [n for n, t in self._threads.items() if t.is_alive()]

    def begin(self, timeout_s: float) -> None:
        """Call the nodes' startups, each in its thread, and then start the clock."""
        self._shared.timeout_s = timeout_s
        with self._stop_lock:
            self._refuse_if_stopped()
            # Before the startups, which may switch torque on: a garbage collection stops all threads, for 0.5 s in a
            # large process, and a servo's watchdog would trip.
            self._process.enter_context(realtime())
            deadline = self._clock.monotonic_s() + timeout_s
            # Under the lock: stop() in another thread then finds either no thread started or all of them.
            self._clock.start(self._watchdog)
            for thread in self._threads.values():
                self._clock.start(thread)
        for name, thread in self._threads.items():
            while not (thread.ready.wait(_POLL_S) or self.ended):
                if self._clock.monotonic_s() > deadline:
                    self._shared.fail(
                        GraphTimeout(
                            f"node {name!r} has not finished its startup after {timeout_s:g} s",
                            hint="check the device that it waits for, or start with a longer timeout_s",
                        )
                    )
        self.check()

        # All nodes are ready: start the clock. Under the lock: once stop() has returned, nothing starts any more.
        with self._stop_lock:
            self._refuse_if_stopped()
            self._clock.begin(_LEAD_S)
            for node in self._nodes.values():
                node.set_clock(self._clock.now_s, self._clock.origin_ns)
            if self._recorder is not None:
                ahead_ns = self._clock.origin_ns - self._clock.monotonic_ns()
                self._recorder.start(time.time_ns() + ahead_ns, self._clock.origin_ns)
            self._shared.go.set()

    def _refuse_if_stopped(self) -> None:
        if self.ended:
            raise Sim2RealError("the graph was stopped while it started", hint="call start() or reset() again")

    def check(self) -> None:
        """If the graph has a failure that was not raised yet, stop the graph and raise the failure."""
        if self._shared.failure is not None:
            self.stop(self._shared.timeout_s)

    def observe(self, timeout_s: float) -> StepState:
        """Wait for the supervisor's next step."""
        if self._handover.autonomous:
            raise UsageError(
                f"the supervisor {self._supervisor!r} makes its own steps",
                hint="call reset() instead of start() to make them yourself",
            )
        step_state = self._handover.observe(timeout_s)
        self.check()
        if step_state is None:
            self._missing(f"no step of the supervisor {self._supervisor!r} within {timeout_s:g} s")
        return step_state

    def reply(self, reply: Reply) -> int:
        """Reply to the step on offer; return the number of finished steps after it."""
        return self._handover.reply(reply)

    def settle(self, finished: int, timeout_s: float) -> None:
        """Wait until the supervisor has finished ``finished`` steps."""
        done = self._handover.settle(finished, timeout_s)
        self.check()
        if not done:
            self._missing(f"the supervisor {self._supervisor!r} has not finished its step after {timeout_s:g} s")

    def run_for(self, duration_s: float) -> None:
        """Let the graph run for ``duration_s``, with the supervisor's own ``step``; return early if it is stopped."""
        self._handover.set_autonomous(True)
        self._shared.stopping.wait(duration_s)
        self.check()
        if self._gym:
            self._handover.set_autonomous(False)

    def wait(self, timeout_s: float | None) -> bool:
        """Wait until the graph stops; return False after a timeout."""
        ended = self._shared.stopping.wait(timeout_s)
        self.check()
        return ended

    def stop(self, timeout_s: float) -> None:
        """Stop all nodes and make them safe; raise the graph's failure, if it has one that was not raised yet.

        A call that is interrupted, e.g. by Ctrl-C, can be made again.
        """
        self._shared.timeout_s = timeout_s
        self._shared.stop()
        if threading.current_thread() in self._threads.values():
            return  # a node stops its own graph: its thread cannot wait for itself
        deadline = self._clock.monotonic_s() + timeout_s
        with self._stop_lock:
            if not self.stopped:
                self._end(deadline)
                self.stopped = True
            failure = self._shared.deliver()
        if failure is not None:
            raise failure

    def snapshot(self) -> GraphState:
        """Return the graph's state as of each node's last finished step."""
        return snapshot(self._graph_state, self._data, self._supervisor)

    def statistics(self) -> dict[str, NodeStatistics]:
        """Return timing statistics of each node."""
        return {name: thread.log.summary() for name, thread in self._threads.items()}

    def _wake(self) -> None:
        """Wake threads that wait for messages or for the caller."""
        self._handover.close()
        for channel in self._channels.values():
            channel.stop()

    def _end(self, deadline: float) -> None:
        # Wait for the threads.
        begin = self._clock.monotonic_s()
        for thread in self._threads.values():
            if thread.ident is not None:
                over = thread.over.wait(max(0.0, deadline - self._clock.monotonic_s()))
                if over and not thread.made_safe:
                    thread.join(LAST_RESORT_S)
        self._watchdog.finish()
        self._process.close()

        # Make the nodes safe whose threads did not end.
        for name, thread in self._threads.items():
            if thread.is_alive() and not thread.failed:
                if not thread.made_safe:
                    thread.make_safe_from_outside(LAST_RESORT_S)
                waited_s = self._clock.monotonic_s() - begin
                self._shared.fail(
                    GraphTimeout(
                        f"node {name!r} is still in its {thread.during} {waited_s:.1f} s after the stop; "
                        "its stop() was called from outside",
                        hint="give its device or its wait a timeout",
                    )
                )
        for node in self._nodes.values():
            node.set_clock(None)
        self._record_leftovers()

    def _record_leftovers(self) -> None:
        if self._recorder is None:
            return
        try:
            for (name, _), channel in self._channels.items():
                if not self._threads[name].is_alive():
                    for record in channel.leftover():
                        self._recorder.message(record)
        except Sim2RealError as error:
            self._shared.fail(error)
        except Exception as error:  # as a note, if a node has failed: that failure must still reach the caller
            self._shared.fail(Sim2RealError(f"the recorder failed at the end: {type(error).__name__}: {error}"))

    def _missing(self, message: str) -> NoReturn:
        if self.ended:
            raise Sim2RealError("the graph was stopped while a step was awaited", hint="call reset() to start it again")
        raise GraphTimeout(message, hint="is one of its blocking inputs silent?")


MIN_LIMIT_S, PERIODS = 1.0, 10.0
"""A step counts as hanging after ``PERIODS`` periods of its node, at least ``MIN_LIMIT_S`` [s]: a busy laptop can delay
a step by a few hundred milliseconds.
"""
LAST_RESORT_S = 1.0
"""Longest wait for a node's ``stop`` when another thread calls it [s]."""
_GRACE_S = 0.2
"""Time for which a startup may go on after the graph stopped; then another thread calls the node's ``stop`` [s]."""


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
        self._quit, self._over = shared.clock.event(), shared.clock.event()

    def run(self) -> None:
        """Check the threads until the graph has stopped; an exception in this thread stops the graph."""
        try:
            self._shared.clock.keep_time()
            self._watch()
        except BaseException as error:
            self._shared.fail(Sim2RealError(f"the watchdog of the graph failed: {type(error).__name__}: {error}"))
        finally:
            self._over.set()

    def finish(self) -> None:
        """End the watchdog, after the graph has stopped."""
        self._quit.set()
        if self.ident is not None:
            self._over.wait()

    def _watch(self) -> None:
        # Sleep between checks until the earliest time at which a thread could exceed its limit.
        shared, stopped_s = self._shared, 0.0
        while not self._quit.is_set():
            now = shared.clock.monotonic_s()
            if shared.stopping.is_set():
                stopped_s = stopped_s or now
            rests = [self._look(t, now, stopped_s) for t in self._threads if not t.made_safe]
            rest = max(0.0, min([*rests, *self._limits.values()]))
            waiting = self._quit if stopped_s else shared.stopping
            waiting.wait(min(rest, threading.TIMEOUT_MAX))

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
        if during != "startup":  # a startup may still return: then its thread calls stop itself
            thread.over.set()
        return limit
