"""The recorder that writes a log: control threads put records into a queue, and a writer thread writes them."""

import atexit
import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sim2real.errors import ERROR, OK, Sim2RealError
from sim2real.graph.episode import MessageRecord, StepRecord, named_leaves
from sim2real.log.backlog import RECORD_BYTES, Backlog, max_queue_bytes
from sim2real.log.session_file import SessionFile
from sim2real.types import Json, PyTree

# A crash costs at most 0.25 s of data; 0.15 s of it is the margin for a writer thread that wakes late: with 0.05 s, two
# busy cores lost 0.26 s once. A flush each 0.1 s makes the log 8 % larger than one each 0.2 s.
FLUSH_PERIOD_S = 0.1
SYNC_PERIOD_S = 1.0
# `close` checks the writer's progress, and reports it, with these periods.
CHECK_PERIOD_S, REPORT_PERIOD_S = 0.2, 5.0
# The queue's memory is checked once in this many records.
RECORDS_PER_CHECK = 256
# The warning level of rcl_interfaces/msg/Log.
WARN = 30


class McapRecorder:
    """Writes one episode of a graph into one MCAP file; a ``Recorder``.

    ``start``, ``step``, ``message`` and ``write_event`` only queue: they never wait for the disk, and may be called
    from any thread. The next call raises an error of the writer. As a context manager, it writes an exception that
    leaves the block as the status of the session. If the process ends without ``close``, the status is ``aborted``.

    A writer that falls behind loses no record: ``backlog`` returns its delay, and ``close`` waits while it makes
    progress. The queue's memory has a limit: beyond it every call raises an error, and the queued records are written.

    Args:
        path: The file; it must not exist.
        metadata: Metadata of the session (pipeline, configuration, versions, ...), as JSON has it. The key ``log`` is
            reserved.
        attachments: File name -> content.
        outputs: Node -> an example of its output, such as ``init_output`` returns; all outputs must have its shapes.
        joint_states: Node -> joint -> quantity (``position``, ``velocity``, ``effort``) -> field of the node's output
            (``"th"``, ``"q[2]"``): also written as ``/joint_states``, which viewers plot without configuration.
        units: Node -> field, or entry of one (``"aim[0]"``) -> unit.

    Raises:
        Sim2RealError: When the file exists or cannot be created, the metadata cannot be written as JSON, two names get
            the same ROS name, or an output has a dtype that ROS lacks.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Json],
        attachments: Mapping[str, bytes],
        outputs: Mapping[str, PyTree],
        inputs: Iterable[tuple[str, str]],
        joint_states: Mapping[str, Mapping[str, Mapping[str, str]]] | None = None,
        units: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        if "log" in metadata:
            raise Sim2RealError("the session's metadata has the key 'log', which is reserved for the reader")
        self.path = Path(path)
        self._names = {node: dict.fromkeys(named_leaves(example)) for node, example in outputs.items()}
        self._file = SessionFile(self.path, metadata, attachments, outputs, inputs, joint_states or {}, units)
        # The queue between the control loops and the writer's thread.
        self._queue: queue.SimpleQueue[tuple[float, Callable[..., None], tuple[Any, ...]] | None]
        self._queue = queue.SimpleQueue()
        self._longest_queue = 0
        self._longest_behind_s = 0.0
        self._max_bytes = max_queue_bytes()
        # Memory of the arrays in each node's outputs, which have the shapes of the example.
        self._sizes = {
            node: sum(np.asarray(leaf).nbytes for leaf in named_leaves(example).values())
            for node, example in outputs.items()
        }
        self._queued = dict.fromkeys(outputs, 0)  # steps of each node, which one thread counts
        self._written = dict.fromkeys(outputs, 0)
        self._puts = 0
        self._at_s = self._began_s = 0.0  # when the present record was queued, and when its write began
        self._busy = False
        self._error: BaseException | None = None
        self._failed: Sim2RealError | None = None
        self._overflow: Sim2RealError | None = None
        self._started = False
        self._closed = False
        self._lock = threading.Lock()
        # Start the thread; at exit it writes the rest of the queue.
        self._thread = threading.Thread(target=self._run, name="log-writer", daemon=True)
        self._thread.start()
        atexit.register(self._close_at_exit)

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Queue the episode's start.

        Args:
            epoch_ns: Time 0 on the wall clock [ns].
            monotonic_ns: Time 0 on the monotonic clock [ns].
        """
        if self._started:
            raise Sim2RealError(f"the log {self.path} has an episode already", hint="open one log for each episode")
        self._started = True
        self._put(self._file.start, epoch_ns, monotonic_ns)

    def step(self, record: StepRecord, output: PyTree) -> None:
        """Queue a step that has ended, and its output: a pytree like the example, or a mapping by leaf name."""
        leaves = _snapshot(record.node, output, self._names.get(record.node, {}))
        self._put(self._file.step, record, leaves)
        if record.node in self._queued:
            self._queued[record.node] += 1

    def message(self, record: MessageRecord) -> None:
        """Queue the record of a message."""
        self._put(self._file.message, record)

    def write_event(self, kind: str, text: str, level: int = WARN, ticks: int | None = None) -> None:
        """Queue an event, such as a safety stop, which viewers show as a log line; also allowed before ``start``.

        Args:
            level: Level as in ROS: 20 information, 30 warning, 40 error, 50 fatal.
            ticks: Time of the event on a simulated clock [us from the episode's start]; None: now.
        """
        self._put(self._file.event, time.monotonic_ns(), ticks, level, kind, text)

    def backlog(self) -> Backlog:
        """Return the records that are not written yet; callable from any thread."""
        records = self._queue.qsize() + self._busy
        arrays = sum(self._sizes[n] * max(0, self._queued[n] - self._written[n]) for n in self._sizes)
        now_s = time.monotonic()
        behind_s, idle_s = (now_s - self._at_s, now_s - self._began_s) if self._busy else (0.0, 0.0)
        return Backlog(records, RECORD_BYTES * records + arrays, behind_s, idle_s)

    def close(
        self,
        status: str = "finished",
        exit_code: int = OK,
        summary: Mapping[str, Json] | None = None,
        report: Callable[[str], None] | None = None,
    ) -> None:
        """Write all queued records and ``session_end``, and close the file. Later calls do nothing.

        It waits while the writer makes progress.

        Args:
            status: End of the session, in a word or a sentence.
            summary: More values for ``session_end`` (overruns, drops, ...), as JSON has them.
            report: Called with the progress, a sentence, every few seconds.

        Raises:
            Sim2RealError: When a record could not be written, or the disk has taken no data for a minute.
        """
        # Close once: the interpreter's exit can call this at the same time.
        with self._lock:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self._close_at_exit)
        # Wait for the queue, then write the end of the session.
        self._queue.put(None)
        self._drain(report)
        if self._error is None:
            try:
                self._file.finish(
                    {
                        **(summary or {}),
                        "status": status,
                        "exit_code": exit_code,
                        "messages": self._file.counts,
                        "longest_queue": self._longest_queue,
                        "longest_behind_s": round(self._longest_behind_s, 3),
                    }
                )
            except (OSError, Sim2RealError) as error:
                self._error = error
        if self._error is not None:
            self._file.abandon()
            raise self._failure() from self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        del kind, traceback
        if error is None:
            self.close()
            return
        try:
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
            self.close(status, getattr(error, "exit_code", ERROR))
        except Sim2RealError as failure:
            # The exception that left the block is raised; this one is added to it.
            error.add_note(str(failure))

    def _put(self, write: Callable[..., None], *arguments: Any) -> None:
        if self._error is not None:
            raise self._failure() from self._error
        if self._closed:
            raise Sim2RealError(f"the log {self.path} is closed")
        if self._overflow is not None:
            raise self._overflow
        self._queue.put((time.monotonic(), write, arguments))
        self._puts += 1
        # Check the queue's memory once in many records, as the check takes longer than a put.
        if self._puts % RECORDS_PER_CHECK == 0 and (left := self.backlog()).bytes > self._max_bytes:
            self._overflow = Sim2RealError(
                f"{left}: more than {self._max_bytes / 1e6:.0f} MB of the log {self.path} would wait in memory",
                hint="the log holds every record until now; record fewer or smaller outputs, at a lower rate, close "
                "other programs on this machine, or write to a faster, local disk",
            )

    def _drain(self, report: Callable[[str], None] | None) -> None:
        """Wait until the writer has written the queue."""
        report_s = time.monotonic() + REPORT_PERIOD_S
        while self._thread.is_alive():
            self._thread.join(CHECK_PERIOD_S)
            # Wait as long as the disk takes data.
            left = self.backlog()
            if left.stuck and self._thread.is_alive():
                raise Sim2RealError(
                    f"the disk took no data for {left.idle_s:.0f} s: the log {self.path} has no end, "
                    f"{left.records:,} records are lost",
                    hint="the written part of the log can be read; write logs to a local disk",
                )
            if report is not None and left.records and time.monotonic() >= report_s:
                report(f"writing the log: {left}")
                report_s += REPORT_PERIOD_S

    def _failure(self) -> Sim2RealError:
        """Return the error that all later calls raise; it is one object, so that it is reported once."""
        if self._failed is None:
            hint = None
            if isinstance(self._error, OSError):
                hint = "check the disk's free space; the part written before opens with a warning"
            self._failed = Sim2RealError(f"writing the log {self.path} failed: {self._error}", hint)
        return self._failed

    def _run(self) -> None:
        """Write the records of the queue until None comes."""
        try:
            # Write queued records until the queue holds None.
            flush_at = time.monotonic() + FLUSH_PERIOD_S
            sync_at = time.monotonic() + SYNC_PERIOD_S
            while True:
                with contextlib.suppress(queue.Empty):
                    item = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
                    if item is None:
                        return
                    self._write(*item)
                # Flush after each period, so that a crash costs little data; sync less often, as it takes longer.
                if (now := time.monotonic()) < flush_at:
                    continue
                left = self.backlog()
                self._longest_queue = max(self._longest_queue, left.records)
                self._longest_behind_s = max(self._longest_behind_s, left.behind_s)
                self._at_s, self._began_s, self._busy = self._at_s if left.records else now, now, True
                self._file.flush()
                flush_at = now + FLUSH_PERIOD_S
                if now >= sync_at:
                    self._began_s = time.monotonic()
                    self._file.sync()
                    sync_at = now + SYNC_PERIOD_S
                self._busy = not self._queue.empty()
        except BaseException as error:
            self._error = error

    def _write(self, at_s: float, write: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Write one record."""
        self._at_s, self._began_s, self._busy = at_s, time.monotonic(), True
        write(*arguments)
        if write == self._file.step:
            self._written[arguments[0].node] += 1
        self._busy = not self._queue.empty()

    def _close_at_exit(self) -> None:
        # The interpreter is exiting: a failure could not be reported.
        with contextlib.suppress(Sim2RealError):
            self.close("aborted", ERROR)


def _snapshot(node: str, output: PyTree, expected: dict[str, None]) -> list[PyTree]:
    """Return the leaves of an output; writable numpy arrays are copied, as the caller may change them."""
    if isinstance(output, Mapping) and output.keys() == expected.keys():
        leaves = [output[name] for name in expected]
    elif isinstance(output, Mapping) and expected and not any(isinstance(value, Mapping) for value in output.values()):
        raise Sim2RealError(
            f"the output of node {node!r} has the fields {', '.join(output)}, expected {', '.join(expected)}"
        )
    else:
        from sim2real import pytree  # imported late: a log of plain dictionaries is written without JAX

        leaves = pytree.leaves(output)
    return [leaf.copy() if type(leaf) is np.ndarray and leaf.flags.writeable else leaf for leaf in leaves]
