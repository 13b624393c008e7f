"""A connection on the wall clock: stamps messages when they arrive, hands them over by the timing rules."""

import threading
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from sim2real.graph.episode import MessageRecord
from sim2real.graph.node import Connection
from sim2real.graph.rules import eligible, quota
from sim2real.runtime.clock import MonotonicClock
from sim2real.runtime.data import Message
from sim2real.runtime.failure import Stopped

_CHUNK = 1024


class Table:
    """The values of a vectorised function of the step number, computed in chunks: cheaper than one numpy call a step.

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
        self._condition = threading.Condition(threading.Lock())
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
            while self._arrived < upto and not self._stopped:
                self._condition.wait()
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
        """Return the records of messages that no finished step consumed; called when both threads have ended."""
        return (self._record(m, -1) for m in (*self._taken, *self._queue))

    def _due(self, upto: int) -> int:
        """Return the number of queued messages with a ``seq`` below ``upto``."""
        return min(len(self._queue), max(0, upto - self._queue[0].seq)) if self._queue else 0

    def _record(self, m: Message, seq_in: int) -> MessageRecord:
        c = self.connection
        return MessageRecord(c.input_node.name, c.name, m.seq, seq_in, m.sent, m.received)
