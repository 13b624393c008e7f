"""The threads of a graph on the wall clock: each runs one node; channels and the supervisor's handover join them."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.episode import MessageRecord, Recorder, StepRecord
from sim2real.graph.node import Connection, phase_ticks
from sim2real.graph.rules import eligible, next_drift, quota, slot, start, waits_for_schedule
from sim2real.runtime.clock import MonotonicClock
from sim2real.runtime.failure import GraphTimeout, Stopped, named
from sim2real.runtime.statistics import StepLog
from sim2real.runtime.steps import Message, NodeData, Reply, Result, Stepper, overwritten

_CHUNK = 1024


class Table:
    """A function of the step number, evaluated for many steps at once: cheaper than one numpy call for each step.

    Args:
        rule: Maps step numbers, shape ``(n,)``, to integers of the same shape.
    """

    def __init__(self, rule: Callable[[np.ndarray], np.ndarray]) -> None:
        self._rule = rule
        self._first, self._values = 0, rule(np.arange(_CHUNK)).tolist()

    def __getitem__(self, k: int) -> int:
        if not 0 <= k - self._first < _CHUNK:
            self._first = k
            self._values = self._rule(np.arange(k, k + _CHUNK)).tolist()
        return self._values[k - self._first]


class MessageChannel:
    """The queue of one connection's messages, between the sender's thread and the reader's."""

    def __init__(self, connection: Connection, clock: MonotonicClock) -> None:
        self.connection = connection
        self._clock = clock
        self._condition = clock.condition()
        self._queue: deque[Message] = deque()
        self._arrived = 0
        self._last_arrival = 0
        self._taken: list[Message] = []
        self._stopped = False
        self._quota = Table(lambda k: quota(connection, k)) if connection.blocking else None

    def put(self, seq: int, sent: int, leaves: list[np.ndarray]) -> None:
        """Deliver a message, which arrives now; called by the sender.

        Args:
            sent: Time at which it was sent [ticks].
        """
        with self._condition:
            received = max(self._clock.now(), sent, self._last_arrival)
            self._last_arrival = received
            self._queue.append(Message(seq, sent, received, leaves))
            self._arrived += 1
            self._condition.notify()

    def stop(self) -> None:
        """End the channel: a reader that waits gets ``Stopped``."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def wait_group(self, k: int) -> int:
        """Wait for the messages that step ``k`` needs; a non-blocking input needs none.

        Returns:
            Arrival of the last one [ticks]; 0 if there is none.

        Raises:
            Stopped: The graph stopped meanwhile.
        """
        if self._quota is None:
            return 0
        upto = self._quota[k]
        with self._condition:
            self._condition.wait_for(lambda: self._arrived >= upto or self._stopped)
            if self._stopped:
                raise Stopped
            due = self._due(upto)
            return self._queue[due - 1].received if due else 0

    def take(self, k: int, begin: int) -> list[Message]:
        """Return the messages that step ``k``, which starts at ``begin`` [ticks], consumes (rule 6)."""
        with self._condition:
            # Count the messages at the head of the queue that belong to this step.
            if not self._queue:
                due = 0
            elif self._quota is not None:
                due = self._due(self._quota[k])
            else:
                received = np.array([m.received for m in self._queue], np.int64)
                earliest = eligible(self.connection, received, self._queue[0].seq)
                due = int(np.searchsorted(earliest, begin, side="right"))
            self._taken = [self._queue.popleft() for _ in range(due)]
        return self._taken

    def consumed(self, k: int) -> Iterator[MessageRecord]:
        """Return the records of the messages that step ``k`` took; called when the step has finished."""
        taken, self._taken = self._taken, []
        return (self._record(m, k) for m in taken)

    def leftover(self) -> Iterator[MessageRecord]:
        """Return the records of messages that no finished step consumed; called once, when both threads have ended."""
        rest, self._taken = [*self._taken, *self._queue], []
        self._queue.clear()
        return (self._record(m, -1) for m in rest)

    def _due(self, upto: int) -> int:
        """Return the number of queued messages with a ``seq`` below ``upto``."""
        return min(len(self._queue), max(0, upto - self._queue[0].seq)) if self._queue else 0

    def _record(self, m: Message, seq_in: int) -> MessageRecord:
        c = self.connection
        return MessageRecord(c.input_node.name, c.name, m.seq, seq_in, m.sent, m.received)


class Handover:
    """The supervisor offers its step state and waits; the caller observes it and replies.

    Args:
        autonomous: Whether the node's own ``step`` is called at first, without waiting for a caller.
    """

    def __init__(self, autonomous: bool, clock: MonotonicClock) -> None:
        self._condition = clock.condition()
        self._autonomous = autonomous
        self._closed = False
        self._offered: StepState | None = None
        self._reply: Reply | None = None
        self._finished = 0

    @property
    def autonomous(self) -> bool:
        """Whether the node's own ``step`` is called."""
        return self._autonomous

    def set_autonomous(self, autonomous: bool) -> None:
        """Let the node (True) or the caller (False) make all steps from now on, also the one on offer."""
        with self._condition:
            self._autonomous = autonomous
            if autonomous:
                self._offered = None
            self._condition.notify_all()

    def close(self) -> None:
        """Wake both sides, for good: the graph is stopping."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def meet(self, step_state: StepState, timeout_s: float) -> Reply:
        """Offer a step and wait for the reply; called by the supervisor's thread.

        Raises:
            Stopped: The graph stopped meanwhile.
            GraphTimeout: There was no reply in time.
        """
        with self._condition:
            # Offer the step, and wait for the caller's reply.
            if not self._autonomous:
                self._offered = step_state
                self._condition.notify_all()
                self._condition.wait_for(lambda: self._reply or self._autonomous or self._closed, timeout_s)
                self._offered = None
            reply, self._reply = self._reply, None
            if reply is not None:
                return reply
            if self._closed:
                raise Stopped
            if not self._autonomous:
                raise GraphTimeout(
                    f"the supervisor waited {timeout_s:g} s for its output, so the graph stopped",
                    hint="call step() in time, or give AsyncGraph a longer timeout_s",
                )
            return Reply()

    def finished(self) -> None:
        """Count a step after it was sent and recorded; called by the supervisor's thread."""
        with self._condition:
            self._finished += 1
            self._condition.notify_all()

    def observe(self, timeout_s: float) -> StepState | None:
        """Wait for a step on offer and return it; None after a timeout or a stop. Called by the caller."""
        with self._condition:
            self._condition.wait_for(lambda: self._offered is not None or self._closed, timeout_s)
            return None if self._closed else self._offered

    def reply(self, reply: Reply) -> int:
        """Reply to the step on offer; return the number of finished steps after it. Called by the caller."""
        with self._condition:
            self._offered, self._reply = None, reply
            self._condition.notify_all()
            return self._finished + 1

    def settle(self, finished: int, timeout_s: float) -> bool:
        """Wait until ``finished`` steps are finished; return False after a timeout. Called by the caller."""
        with self._condition:
            self._condition.wait_for(lambda: self._finished >= finished or self._closed, timeout_s)
            return self._finished >= finished


class Shared:
    """The common state of an episode's threads: the clock, the signal to stop, and the first failure.

    Args:
        recorder: Receives all steps and messages, or None.
        wake: Called when the graph stops: wakes threads that wait for messages or for the caller.
        answer_timeout_s: Longest wait of the supervisor for its caller [s].
    """

    def __init__(
        self,
        clock: MonotonicClock,
        recorder: Recorder | None,
        graph_state: GraphState,
        wake: Callable[[], None],
        answer_timeout_s: float,
    ) -> None:
        self.clock, self.recorder, self.graph_state = clock, recorder, graph_state
        self.answer_timeout_s = answer_timeout_s
        self.timeout_s = answer_timeout_s
        self.go, self.stopping = clock.event(), clock.event()
        self.failure: Sim2RealError | None = None
        self._wake = wake
        self._lock = clock.lock()
        self._delivered = False

    def stop(self) -> None:
        """Signal every thread to end."""
        self.stopping.set()
        self.go.set()
        self._wake()

    def fail(self, error: Sim2RealError) -> None:
        """Stop the graph because of an error; later errors are added to the first as notes."""
        try:
            with self._lock:
                if self.failure is None:
                    self.failure = error
                elif self.failure is not error:
                    self.failure.add_note(f"then: {error}")
        finally:
            self.stop()

    def deliver(self) -> Sim2RealError | None:
        """Return the failure at the first call, so that it is raised once; None at later calls, or without one."""
        with self._lock:
            failure = None if self._delivered else self.failure
            self._delivered = self._delivered or failure is not None
            return failure


class NodeThread(threading.Thread):
    """Runs a node's startup, steps and stop in one thread, so that ``stop`` comes after the last step.

    If the startup or a step hangs, another thread calls ``stop``. If the hanging call returns later, this thread calls
    ``stop`` again, because the call may have switched something on.

    Args:
        handover: Synchronises the supervisor with its caller; None for the other nodes.

    Attributes:
        ready: Set once the startup has succeeded or failed.
        over: Set when the thread has ended, or its step hangs: nobody waits for it any more.
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
        self.ready, self.over = shared.clock.event(), shared.clock.event()
        self.made_safe = self.failed = False
        self.log = StepLog(inputs)
        self.during = "startup"
        self.since_s: float | None = None
        self._safe_lock = shared.clock.lock()

    def run(self) -> None:
        """Run until the graph stops; the ``stop`` of a node whose startup was called is called in every case."""
        try:
            # A graph that was stopped before the startup has switched on no hardware.
            if not self.shared.stopping.is_set():
                self._live()
        finally:
            self.shared.stop()  # any exception stops the graph: no graph runs without one of its nodes
            self.ready.set()
            self.over.set()

    def make_safe_from_outside(self, timeout_s: float) -> None:
        """Call the node's ``stop`` from a helper thread, as this one is busy, and wait for it up to ``timeout_s``."""
        self.made_safe = True
        done = self.shared.clock.event()

        def make_safe() -> None:
            self._make_safe(True)
            done.set()

        try:
            helper = threading.Thread(target=make_safe, name=f"sim2real:stop of {self.node.name}", daemon=True)
            self.shared.clock.start(helper)
        except RuntimeError:  # the system has no thread left
            make_safe()
        done.wait(timeout_s)

    def _live(self) -> None:
        try:
            # Start up, wait for the other nodes, then run.
            self.since_s = self.shared.clock.monotonic_s()
            if not self.node.startup(self.shared.graph_state, self.shared.timeout_s):
                raise Sim2RealError(f"the startup of node {self.node.name!r} did not succeed")
            self.since_s = None
            self.ready.set()
            self.shared.go.wait()
            self.shared.clock.keep_time()  # only now, as the startup may have computed for a long time
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
            if not clock.sleep_past(begin, shared.stopping):
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
        self.since_s = self.shared.clock.monotonic_s()  # only now, as the caller's time does not count
        return self.stepper.answer(self.data, offered, {}, reply)

    def _record(self, record: StepRecord, result: Result) -> None:
        recorder = self.shared.recorder
        if recorder is None:
            return
        recorder.step(record, self.data.form.unpack(result.leaves))
        for channel in self.inputs.values():
            for message in channel.consumed(record.seq):
                recorder.message(message)
