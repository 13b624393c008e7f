"""The thread of one node on the wall clock: startup, steps by the timing rules, stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import count

from sim2real.errors import Sim2RealError
from sim2real.graph.base import GraphState
from sim2real.graph.episode import Recorder, StepRecord
from sim2real.graph.node import phase_ticks
from sim2real.graph.schedule import next_drift, slot, start, waits_for_schedule
from sim2real.runtime.channel import Channel, Table
from sim2real.runtime.clock import MonotonicClock
from sim2real.runtime.data import NodeData
from sim2real.runtime.failure import Stopped, named
from sim2real.runtime.handover import Handover, Reply
from sim2real.runtime.statistics import StepLog
from sim2real.runtime.stepper import Result, Stepper, overwritten


class Shared:
    """What the threads of one episode have in common: its clock, its end and its first failure."""

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
        """Make every thread leave its loop; nodes have ``timeout_s`` for their ``stop``."""
        self.timeout_s = timeout_s
        self._end()

    def fail(self, error: Sim2RealError) -> None:
        """Stop the graph because of an error; later ones become notes of the first."""
        with self._lock:
            if self.failure is None:
                self.failure = error
            elif self.failure is not error:
                self.failure.add_note(f"then: {error}")
        self._end()

    def deliver(self) -> Sim2RealError | None:
        """Return the failure, once."""
        with self._lock:
            failure = None if self._delivered else self.failure
            self._delivered = self._delivered or failure is not None
            return failure

    def _end(self) -> None:
        self.stopping.set()
        self.go.set()
        self._wake()


class NodeThread(threading.Thread):
    """Startup, steps and stop of a node all run here, so that ``stop`` never overtakes the last step.

    Unless one of them hangs: then ``stop`` is called from outside, and here once more should the node ever come back,
    as what it did meanwhile may have undone the first.

    Args:
        stepper: The node's prepared stepper.
        data: Its data.
        inputs: Its channels by input name.
        outputs: The channels of its readers.
        shared: What all threads share.
        handover: Where the supervisor meets its caller; None for the other nodes.

    Attributes:
        ready: Set once the startup is over, one way or another.
        over: Set when there is nothing more to wait for: the thread has ended, or its step hangs.
        made_safe: Whether the node's ``stop`` was called from outside.
        failed: Whether the graph stopped because a step of this node hangs.
        during: What the thread does: ``startup``, ``step 12`` or ``stop``.
        since_s: Since when startup or a step runs, on the machine's monotonic clock [s]; None while neither does.
    """

    def __init__(
        self,
        stepper: Stepper,
        data: NodeData,
        inputs: Mapping[str, Channel],
        outputs: Sequence[Channel],
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
        """Run until the graph stops; whatever happens, the ``stop`` of a node that was started up is called."""
        try:
            if not self.shared.stopping.is_set():  # else nothing has been switched on, and nothing shall be
                self._live()
        finally:
            self.ready.set()
            self.over.set()

    def make_safe_from_outside(self, timeout_s: float) -> None:
        """Call the node's ``stop`` although its thread is busy, and wait for that for a while."""
        self.made_safe = True
        helper = threading.Thread(target=self._make_safe, args=(True,), daemon=True)
        helper.start()
        helper.join(timeout_s)

    def _live(self) -> None:
        try:
            self.since_s = time.monotonic()
            if not self.node.startup(self.shared.graph_state, self.shared.timeout_s):
                raise Sim2RealError(f"the startup of node {self.node.name!r} did not succeed")
            self.since_s = None
            self.ready.set()
            self.shared.go.wait()
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
                return  # it came back
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
            scheduled = slots[k]
            blocked = max((channel.wait_group(k) for channel in self.inputs.values()), default=0)
            begin = int(start(scheduled, drift, end, blocked, waits))
            later = int(next_drift(node.scheduling, scheduled, drift, end))
            overrun = end > max(scheduled + drift, blocked)
            if not clock.sleep_past(begin, shared.stopping, shared.spin):
                return
            woken = clock.now()
            for name, channel in self.inputs.items():
                taken = channel.take(k, begin)
                self.data.windows[name].push(taken)
                self.log.read(name, begin, taken[-1].sent if taken else None)
            result = self._step(k, begin)
            end = clock.now()
            moved = overwritten(result.ts, begin, end, node.name)
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
        given = self.data.step_state(k, begin)
        reply = self.handover.meet(given, self.shared.answer_timeout_s) if self.handover else Reply()
        self.since_s = time.monotonic()  # not before: the caller may take its time
        return self.stepper.answer(self.data, given, {}, reply)

    def _record(self, record: StepRecord, result: Result) -> None:
        recorder = self.shared.recorder
        if recorder is None:
            return
        recorder.step(record, self.data.form.unpack(result.leaves))
        for channel in self.inputs.values():
            for message in channel.consumed(record.seq):
                recorder.message(message)
