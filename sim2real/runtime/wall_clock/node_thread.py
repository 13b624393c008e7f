"""The thread of one node on the wall clock: its startup, its steps by the timing rules, its stop."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import count

from sim2real.errors import Sim2RealError
from sim2real.graph.base import GraphState
from sim2real.graph.episode import Recorder, StepRecord
from sim2real.graph.node import phase_ticks
from sim2real.graph.rules import next_drift, slot, start, waits_for_schedule
from sim2real.runtime.clock import MonotonicClock, keep_time
from sim2real.runtime.data import NodeData
from sim2real.runtime.failure import Stopped, named
from sim2real.runtime.statistics import StepLog
from sim2real.runtime.stepper import Result, Stepper, overwritten
from sim2real.runtime.wall_clock.channel import MessageChannel, Table
from sim2real.runtime.wall_clock.handover import Handover, Reply


class Shared:
    """The common state of an episode's threads: the clock, the signal to stop, and the first failure.

    Args:
        recorder: Receives all steps and messages, or None.
        wake: Called when the graph stops: wakes threads that wait for messages or for the caller.
        spin: Time before each step in which a thread polls the clock instead of sleeping [ticks].
        answer_timeout_s: Longest wait of the supervisor for its caller [s].
    """

    def __init__(
        self,
        clock: MonotonicClock,
        recorder: Recorder | None,
        graph_state: GraphState,
        wake: Callable[[], None],
        spin: int,
        answer_timeout_s: float,
    ) -> None:
        self.clock, self.recorder, self.graph_state, self.spin = clock, recorder, graph_state, spin
        self.answer_timeout_s = answer_timeout_s
        self.timeout_s = answer_timeout_s
        self.go = threading.Event()
        self.stopping = threading.Event()
        self.failure: Sim2RealError | None = None
        self._wake = wake
        self._lock = threading.Lock()
        self._delivered = False

    def stop(self, timeout_s: float) -> None:
        """Signal every thread to end; each node's ``stop`` gets ``timeout_s`` [s]."""
        self.timeout_s = timeout_s
        self._end()

    def fail(self, error: Sim2RealError) -> None:
        """Stop the graph because of an error; later errors are added to the first as notes."""
        with self._lock:
            if self.failure is None:
                self.failure = error
            elif self.failure is not error:
                self.failure.add_note(f"then: {error}")
        self._end()

    def deliver(self) -> Sim2RealError | None:
        """Return the failure at the first call; None if there is none, or at later calls."""
        with self._lock:
            failure = None if self._delivered else self.failure
            self._delivered = self._delivered or failure is not None
            return failure

    def _end(self) -> None:
        self.stopping.set()
        self.go.set()
        self._wake()


class NodeThread(threading.Thread):
    """Runs a node's startup, steps and stop in one thread, so that ``stop`` comes after the last step.

    If the startup or a step hangs, another thread calls ``stop``. Should the hanging call return later, this thread
    calls ``stop`` again, as that call may have switched something on.

    Args:
        handover: Synchronises the supervisor with its caller; None for the other nodes.

    Attributes:
        ready: Set once the startup has succeeded or failed.
        over: Set when the thread has ended, or its step hangs: other threads need not wait for it any more.
        made_safe: Whether another thread has called the node's ``stop``.
        failed: Whether the graph stopped because a step of this node hangs.
        during: The call in progress: ``startup``, ``step 12`` or ``stop``.
        since_s: Begin of the running startup or step, on the machine's monotonic clock [s]; None while neither runs.
    """

    def __init__(
        self,
        stepper: Stepper,
        data: NodeData,
        inputs: Mapping[str, MessageChannel],
        outputs: Sequence[MessageChannel],
        shared: Shared,
        handover: Handover | None,
    ) -> None:
        super().__init__(name=f"sim2real:{stepper.node.name}", daemon=True)
        self.node, self.stepper, self.data = stepper.node, stepper, data
        self.inputs, self.outputs, self.shared, self.handover = inputs, outputs, shared, handover
        self.ready, self.over = threading.Event(), threading.Event()
        self.made_safe = self.failed = False
        self.log = StepLog(inputs)
        self.during = "startup"
        self.since_s: float | None = None
        self._safe_lock = threading.Lock()

    def run(self) -> None:
        """Run until the graph stops; the ``stop`` of a node whose startup was called is called in every case."""
        try:
            # A graph that was stopped before the startup has switched on no hardware.
            if not self.shared.stopping.is_set():
                self._live()
        finally:
            self.ready.set()
            self.over.set()

    def make_safe_from_outside(self, timeout_s: float) -> None:
        """Call the node's ``stop`` from a helper thread, as this one is busy, and wait for it up to ``timeout_s``."""
        self.made_safe = True
        helper = threading.Thread(target=self._make_safe, args=(True,), daemon=True)
        helper.start()
        helper.join(timeout_s)

    def _live(self) -> None:
        try:
            # Start up, wait for the other nodes, then run.
            self.since_s = time.monotonic()
            if not self.node.startup(self.shared.graph_state, self.shared.timeout_s):
                raise Sim2RealError(f"the startup of node {self.node.name!r} did not succeed")
            self.since_s = None
            self.ready.set()
            self.shared.go.wait()
            keep_time()  # not before: a startup may compute for long
            self._loop()
        except Stopped:
            pass
        except BaseException as error:
            self.shared.fail(named(error, self.node.name, self.during))
        finally:
            self.during, self.since_s = "stop", None
            self._make_safe(False)

    def _make_safe(self, from_outside: bool) -> None:
        with self._safe_lock:
            if from_outside and self.during == "stop":
                return  # the node's own thread is no longer busy and calls stop itself
            try:
                if not self.node.stop(self.shared.timeout_s):
                    raise Sim2RealError(f"the stop of node {self.node.name!r} did not succeed")
            except BaseException as error:
                self.shared.fail(named(error, self.node.name, "stop"))

    def _loop(self) -> None:
        node, shared, clock = self.node, self.shared, self.shared.clock
        phase, waits = phase_ticks(node), waits_for_schedule(node)
        slots = Table(lambda k: slot(node, k, phase))
        drift = end = 0
        for k in count():
            self.during = f"step {k}"
            # Wait for blocking inputs, then for the start by the timing rules.
            scheduled = slots[k]
            blocked = max((channel.wait_group(k) for channel in self.inputs.values()), default=0)
            begin = start(scheduled, drift, end, blocked, waits)
            later = next_drift(node.scheduling, scheduled, drift, end)
            overrun = end > max(scheduled + drift, blocked)
            if not clock.sleep_past(begin, shared.stopping, shared.spin):
                return
            woken = clock.now()
            # Consume messages and make the step.
            for name, channel in self.inputs.items():
                taken = channel.take(k, begin)
                self.data.windows[name].push(taken)
                self.log.read(name, begin, taken[-1].sent if taken else None)
            result = self._step(k, begin)
            end = clock.now()
            moved = overwritten(result.ts, begin, end, node.name)
            # Send the output, then write the log.
            for channel in self.outputs:
                channel.put(k, end, result.leaves)
            self.data.keep(result.changed)
            self.log.add(begin, woken, overrun)
            self._record(StepRecord(node.name, k, scheduled, begin, woken, moved, end, drift), result)
            self.since_s = None
            if self.handover is not None:
                self.handover.finished()
            drift = later

    def _step(self, k: int, begin: int) -> Result:
        offered = self.data.step_state(k, begin)
        reply = self.handover.meet(offered, self.shared.answer_timeout_s) if self.handover else Reply()
        self.stepper.show(self.shared.recorder, offered, {}, reply)
        self.since_s = time.monotonic()  # only now: the caller's time does not count
        return self.stepper.answer(self.data, offered, {}, reply)

    def _record(self, record: StepRecord, result: Result) -> None:
        recorder = self.shared.recorder
        if recorder is None:
            return
        recorder.step(record, self.data.form.unpack(result.leaves))
        for channel in self.inputs.values():
            for message in channel.consumed(record.seq):
                recorder.message(message)
