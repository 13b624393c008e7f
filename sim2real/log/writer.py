"""The recorder that writes a log: control threads put records into a queue, and a writer thread writes them."""

from __future__ import annotations

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
from sim2real.log.session_file import SessionFile

# A crash may cost at most 0.25 s of data; 0.05 s are left for a writer thread that wakes late.
FLUSH_PERIOD_S = 0.2
SYNC_PERIOD_S = 1.0
# Longer than any working disk needs for the queue.
CLOSE_TIMEOUT_S = 60.0
# The warning level of rcl_interfaces/msg/Log.
WARN = 30


class McapRecorder:
    """Writes one episode of a graph into one MCAP file; a ``Recorder``.

    ``start``, ``step``, ``message`` and ``write_event`` only queue: they never wait for the disk, and may be called
    from any thread. An error while writing is raised by the next call. Used as a context manager, an exception that
    leaves the block becomes the status of the session. If the process ends without closing the log, it is closed with
    the status ``aborted``.

    Args:
        path: The file; it must not exist.
        metadata: Facts about the session (pipeline, configuration, versions, ...): JSON-able. The key ``log`` is
            reserved.
        attachments: File name -> content.
        outputs: Node -> an example of its output, such as ``init_output`` returns; all outputs must have its shapes.
        inputs: The connections, as (node, input name).
        joint_states: Node -> joint -> quantity (``position``, ``velocity``, ``effort``) -> field of the node's output
            (``"th"``, ``"q[2]"``): also written as ``/joint_states``, which viewers plot without configuration.
        units: Node -> field, or entry of one (``"aim[0]"``) -> unit, as far as known.

    Raises:
        Sim2RealError: When the file exists or cannot be created, the metadata cannot be written as JSON, two names get
            the same ROS name, or an output has a dtype that ROS lacks.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Any],
        attachments: Mapping[str, bytes],
        outputs: Mapping[str, Any],
        inputs: Iterable[tuple[str, str]],
        joint_states: Mapping[str, Mapping[str, Mapping[str, str]]] | None = None,
        units: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        if "log" in metadata:
            raise Sim2RealError("the session's metadata has a key 'log', where the reader puts facts about the log")
        self.path = Path(path)
        self._names = {node: dict.fromkeys(named_leaves(example)) for node, example in outputs.items()}
        self._file = SessionFile(self.path, metadata, attachments, outputs, inputs, joint_states or {}, units)
        self._queue: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._longest_queue = 0
        self._error: BaseException | None = None
        self._failed: Sim2RealError | None = None
        self._started = False
        self._closed = False
        self._lock = threading.Lock()
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

    def step(self, record: StepRecord, output: Any) -> None:
        """Queue a step that has ended, and its output: a pytree like the example, or a mapping by leaf name."""
        self._put(self._file.step, record, _snapshot(record.node, output, self._names.get(record.node, {})))

    def message(self, record: MessageRecord) -> None:
        """Queue the record of a message."""
        self._put(self._file.message, record)

    def write_event(self, kind: str, text: str, level: int = WARN, ticks: int | None = None) -> None:
        """Queue an event, such as a safety stop, which viewers show as a log line; also allowed before ``start``.

        Args:
            kind: A short name, for example ``"watchdog"``.
            text: What happened.
            level: Level as in ROS: 20 information, 30 warning, 40 error, 50 fatal.
            ticks: When it happened, for a simulated clock [us from the episode's start]; None: now.
        """
        self._put(self._file.event, time.monotonic_ns(), ticks, level, kind, text)

    def close(self, status: str = "finished", exit_code: int = OK, summary: Mapping[str, Any] | None = None) -> None:
        """Write everything that is queued and ``session_end``, and close the file. Later calls do nothing.

        Args:
            status: How the session ended, in a word or a sentence.
            exit_code: Exit code of the command.
            summary: More facts for ``session_end`` (overruns, drops, ...): JSON-able.

        Raises:
            Sim2RealError: When something could not be written.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self._close_at_exit)
        self._queue.put(None)
        self._thread.join(CLOSE_TIMEOUT_S)
        if self._thread.is_alive():
            raise Sim2RealError(
                f"the disk took no data for {CLOSE_TIMEOUT_S:.0f} s: the log {self.path} has no end",
                hint="what is there opens all the same; write logs to a local disk",
            )
        if self._error is None:
            try:
                self._file.finish(
                    {
                        **(summary or {}),
                        "status": status,
                        "exit_code": exit_code,
                        "messages": self._file.counts,
                        "longest_queue": self._longest_queue,
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
        self._queue.put((write, *arguments))

    def _failure(self) -> Sim2RealError:
        """Return the error that all calls raise from now on: always the same object, so that it is reported once."""
        if self._failed is None:
            hint = None
            if isinstance(self._error, OSError):
                hint = "check the disk's free space; what was written before opens with a warning"
            self._failed = Sim2RealError(f"writing the log {self.path} failed: {self._error}", hint)
        return self._failed

    def _run(self) -> None:
        """Write what is in the queue until None comes."""
        try:
            flush_at = time.monotonic() + FLUSH_PERIOD_S
            sync_at = time.monotonic() + SYNC_PERIOD_S
            while True:
                with contextlib.suppress(queue.Empty):
                    item = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
                    if item is None:
                        return
                    item[0](*item[1:])
                if (now := time.monotonic()) < flush_at:
                    continue
                self._longest_queue = max(self._longest_queue, self._queue.qsize())
                self._file.flush()
                flush_at = now + FLUSH_PERIOD_S
                if now >= sync_at:
                    self._file.sync()
                    sync_at = now + SYNC_PERIOD_S
        except BaseException as error:
            self._error = error

    def _close_at_exit(self) -> None:
        # The interpreter is exiting: a failure could not be reported.
        with contextlib.suppress(Sim2RealError):
            self.close("aborted", ERROR)


def _snapshot(node: str, output: Any, names: dict[str, None]) -> list[Any]:
    """Return the leaves of an output; writable numpy arrays are copied, as the caller may change them."""
    if isinstance(output, Mapping) and output.keys() == names.keys():
        leaves = [output[name] for name in names]
    elif isinstance(output, Mapping) and names and not any(isinstance(value, Mapping) for value in output.values()):
        raise Sim2RealError(
            f"the output of node {node!r} has the fields {', '.join(output)}, expected {', '.join(names)}"
        )
    else:
        import jax  # imported late: a log of plain dictionaries is written without JAX

        leaves = jax.tree_util.tree_leaves(output)
    return [leaf.copy() if type(leaf) is np.ndarray and leaf.flags.writeable else leaf for leaf in leaves]
