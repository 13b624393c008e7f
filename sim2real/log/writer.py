"""Writes a log: control threads put records into a queue, and one thread writes them to the file.

Metadata and attachments are on the disk before the first data, so that a crashed session stays readable.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import mimetypes
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from sim2real.errors import ERROR, OK, Sim2RealError
from sim2real.graph.episode import MessageRecord, StepRecord, named_leaves
from sim2real.log.schema import (
    JointSource,
    Topic,
    input_topic,
    joint_source,
    output_topic,
    step_topic,
    unique_names,
)
from sim2real.log.session import SESSION, SESSION_END, encode
from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    import numpy.typing as npt

# A crash may cost at most 0.25 s of data: 0.1 s between two flushes, and 0.15 s for a writer thread that wakes late. #
# Flushing every 0.1 s makes the log 8 % larger than every 0.2 s.
FLUSH_PERIOD_S = 0.1
SYNC_PERIOD_S = 1.0
# `close` waits for the writer in steps of WAIT_S, reports progress every few steps, and gives up if the writer writes #
# nothing for STUCK_S.
WAIT_S, REPORT_WAITS, STUCK_S = 0.2, 25, 60.0
# Largest memory of the queue, also on a small computer, and memory of a queued record without its arrays [bytes].
MAX_QUEUE_BYTES, RECORD_BYTES = 1 << 28, 500
LIBRARY = "sim2real"
# Size of a chunk [bytes]: small, so that reading a range decompresses little, and a damaged byte costs little data.
CHUNK_BYTES = 64 * 1024


@dataclass
class _Node:
    """The topics of one node.

    Attributes:
        filled: Indices of the output's leaves that are not empty; empty leaves are not written.
        joints: Source of its joint states, or None.
    """

    step: Topic
    output: Topic
    filled: list[int]
    leaves: int
    joints: JointSource | None


class SessionFile:
    """A log that is being written.

    The constructor writes the session's metadata and attachments, and waits until they are on the disk.

    Args:
        path: The file; it must not exist.
        outputs: Node -> an example of its output.
        joint_states: Node -> joint -> quantity -> field of the node's output; see ``McapRecorder``.
        units: Node -> field, or entry of one -> unit.

    Raises:
        Sim2RealError: As ``McapRecorder``.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Json],
        attachments: Mapping[str, bytes],
        outputs: Mapping[str, PyTree],
        inputs: Iterable[tuple[str, str]],
        joint_states: Mapping[str, Mapping[str, Mapping[str, str]]],
        units: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self._nodes = _nodes(outputs, joint_states, units or {})
        self._inputs = _inputs(inputs, self._nodes)
        self._topics = self._all_topics()
        self._channels: dict[str, int] = {}
        self._epoch_ns = 0
        # Encode the metadata before the file exists, so that an error leaves no file.
        session = encode(SESSION, metadata)
        try:
            self._stream = open(path, "xb")  # noqa: SIM115 - finish and abandon close it
        except FileExistsError as error:
            raise Sim2RealError(
                f"the log {path} exists already", hint="logs are never overwritten: choose another name"
            ) from error
        except OSError as error:
            raise Sim2RealError(f"the log {path} cannot be created: {error.strerror}") from error
        # Write metadata and attachments first: a log without them cannot be read.
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_crcs=True)
        try:
            self._writer.start(profile="ros2", library=LIBRARY)
            self._writer.add_metadata(SESSION, session)
            now = time.time_ns()
            for name, data in attachments.items():
                media_type = mimetypes.guess_type(name)[0] or "application/octet-stream"
                self._writer.add_attachment(now, now, name, media_type, data)
            self.flush()
            self.sync()
        except OSError as error:
            self.abandon()
            raise Sim2RealError(
                f"the log {path} cannot be written: {error.strerror}", hint="check the disk's free space"
            ) from error

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Write the channels, whose metadata have the episode's time 0.

        Args:
            epoch_ns: Time 0 on the wall clock [ns].
            monotonic_ns: Time 0 on the monotonic clock [ns].
        """
        self._epoch_ns = epoch_ns
        loose = RecordBuilder()
        schemas: dict[str, int] = {}
        for topic in self._topics:
            schema = schemas.get(topic.schema)
            if schema is None:
                data = topic.schema_text.encode()
                schema = schemas[topic.schema] = self._writer.register_schema(topic.schema, "ros2msg", data)
                Schema(id=schema, name=topic.schema, encoding="ros2msg", data=data).write(loose)
            metadata = {**topic.metadata, "epoch_ns": str(epoch_ns), "monotonic_ns": str(monotonic_ns)}
            channel = self._writer.register_channel(topic.name, "cdr", schema, metadata)
            Channel(channel, topic.name, "cdr", metadata, schema).write(loose)
            self._channels[topic.name] = channel
        # Also write the definitions before the first chunk, so that the other chunks can be read if that one is lost.
        self._stream.write(loose.end())

    def step(self, record: StepRecord, leaves: Sequence[npt.ArrayLike]) -> None:
        """Write a step, its output and its joint states."""
        # Refuse a node or an output that the constructor did not get.
        node = self._nodes.get(record.node)
        if node is None:
            raise Sim2RealError(f"node {record.node!r} is not in this log. Available: {', '.join(self._nodes)}")
        if len(leaves) != node.leaves:
            raise Sim2RealError(
                f"the output of node {record.node!r} has {len(leaves)} leaves, its init_output had {node.leaves}"
            )
        # Write output, step record and joint states with the step's number.
        seq, sent = record.seq, self._epoch_ns + 1000 * record.end
        if node.filled:
            values = _to_host([leaves[i] for i in node.filled])
            try:
                payload = node.output.layout.pack(values)
            except Sim2RealError as error:
                raise Sim2RealError(f"step {seq} of node {record.node!r}, unlike its init_output: {error}") from error
            self._add(node.output, payload, seq, sent, sent)
        self._add(node.step, node.step.layout.pack(record[1:]), seq, sent, self._epoch_ns + 1000 * record.start)
        if node.joints is not None:
            payload = _joint_state(node.joints, leaves, sent)
            self._add(node.joints.topic, payload, seq, sent, sent)

    def message(self, record: MessageRecord) -> None:
        """Write the record of a message."""
        topic = self._inputs.get((record.node, record.input))
        if topic is None:
            available = ", ".join(f"{node}/{name}" for node, name in self._inputs)
            raise Sim2RealError(f"input {record.node}/{record.input} is not in this log. Available: {available}")
        payload = topic.layout.pack((record.seq_out, record.seq_in))
        sent, received = (self._epoch_ns + 1000 * ticks for ticks in (record.sent, record.received))
        self._add(topic, payload, record.seq_out, received, sent)

    def flush(self) -> None:
        """Pass the written records to the operating system, so that they survive the end of this process."""
        self._writer.flush()

    def sync(self) -> None:
        """Wait until the flushed records are on the disk, so that they survive a loss of power."""
        os.fsync(self._stream.fileno())

    def finish(self, end: Mapping[str, Json]) -> None:
        """Write ``session_end`` and the index, and close."""
        self._writer.flush()
        self._writer.add_metadata(SESSION_END, encode(SESSION_END, end))
        self._writer.finish()
        self._stream.flush()
        self.sync()
        self._stream.close()

    def abandon(self) -> None:
        """Close the file without its end."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _all_topics(self) -> list[Topic]:
        """Return the topics of all channels."""
        topics = [t for node in self._nodes.values() for t in (node.step, node.output) if t.layout.fields]
        topics += self._inputs.values()
        return topics + [node.joints.topic for node in self._nodes.values() if node.joints is not None][:1]

    def _add(self, topic: Topic, payload: bytes, sequence: int, log_time: int, publish_time: int) -> None:
        channel = self._channels.get(topic.name)
        if channel is None:
            raise Sim2RealError("the log got data before the episode's start", hint="call start() first")
        self._writer.add_message(channel, log_time, payload, publish_time, sequence)


def _nodes(
    outputs: Mapping[str, PyTree],
    joint_states: Mapping[str, Mapping[str, Mapping[str, str]]],
    units: Mapping[str, Mapping[str, str]],
) -> dict[str, _Node]:
    unique_names(outputs, "the graph", "node")
    nodes, types = {}, {}
    # Derive the topics of each node from the example of its output.
    for name, example in outputs.items():
        leaves = list(named_leaves(example).values())
        node_units = units.get(name, {})
        joints = joint_source(name, example, joint_states[name], node_units) if name in joint_states else None
        filled = [i for i, leaf in enumerate(leaves) if np.size(leaf)]
        node = _Node(step_topic(name), output_topic(name, example, node_units), filled, len(leaves), joints)
        other = types.setdefault(node.output.schema, name)
        if other != name:
            raise Sim2RealError(
                f"nodes {other!r} and {name!r} both get the message type {node.output.schema}",
                hint="underscores do not count in ROS type names: rename one of them",
            )
        nodes[name] = node
    if unknown := set(joint_states) - set(nodes):
        raise Sim2RealError(f"joint states of unknown node {sorted(unknown)[0]!r}. Available: {', '.join(nodes)}")
    return nodes


def _inputs(inputs: Iterable[tuple[str, str]], nodes: Mapping[str, _Node]) -> dict[tuple[str, str], Topic]:
    topics = {}
    for node, name in inputs:
        if node not in nodes:
            raise Sim2RealError(f"input {name!r} of unknown node {node!r}. Available: {', '.join(nodes)}")
        topics[node, name] = input_topic(node, name)
    for node in nodes:
        unique_names((name for n, name in topics if n == node), f"node {node!r}", "input")
    return topics


def _to_host(leaves: list[PyTree]) -> list[PyTree]:
    """Return the leaves as NumPy arrays or numbers; all transfers start before the first wait."""
    for leaf in leaves:
        if hasattr(leaf, "copy_to_host_async"):
            leaf.copy_to_host_async()
    return [np.asarray(leaf) if hasattr(leaf, "__array__") else leaf for leaf in leaves]


def _joint_state(source: JointSource, leaves: Sequence[npt.ArrayLike], time_ns: int) -> bytes:
    values: list[int | list[float]] = [time_ns // 1_000_000_000, time_ns % 1_000_000_000]
    values += [
        [float("nan") if i < 0 else float(np.ravel(leaves[i])[element]) for i, element in picks]
        for picks in source.picks
        if picks
    ]
    return source.topic.layout.pack(values)


class McapRecorder:
    """Writes one episode of a graph into one MCAP file; a ``Recorder``.

    ``start``, ``step`` and ``message`` only queue: they never wait for the disk, and may be called from any thread. If
    writing fails, the next call raises the error. As a context manager, it stores an exception that leaves the block as
    the session's status. If the process ends without ``close``, the status is ``aborted``.

    If the disk is slow, records wait in memory, and ``close`` waits for them. Beyond a limit of memory every call
    raises an error, and the queued records are still written.

    Args:
        path: The file; it must not exist.
        metadata: Metadata of the session (pipeline, configuration, versions, ...), as JSON values. The key ``log`` is
            reserved.
        attachments: File name -> content.
        outputs: Node -> an example of its output, such as ``init_output`` returns; all outputs must have its shapes.
        joint_states: Node -> joint -> quantity (``position``, ``velocity``, ``effort``) -> field of the node's output
            (``"th"``, ``"q[2]"``): also written as ``/joint_states``, which viewers plot without configuration.
        units: Node -> field, or entry of one (``"aim[0]"``) -> unit.

    Raises:
        Sim2RealError: The file exists or cannot be created, the metadata cannot be written as JSON, two names get the
            same ROS name, or an output has a dtype that ROS lacks.
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
        # The queue between the control loops and the writer's thread: method and arguments.
        self._queue: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        sizes = [
            sum(np.asarray(leaf).nbytes for leaf in named_leaves(example).values()) for example in outputs.values()
        ]
        self._most_waiting = MAX_QUEUE_BYTES // (RECORD_BYTES + max(sizes, default=0))
        self._done = 0
        self._error: BaseException | None = None
        self._failed: Sim2RealError | None = None
        self._started = self._closed = False
        self._lock = threading.Lock()
        # Start the thread; at exit it writes the rest of the queue.
        self._thread = threading.Thread(target=self._run, name="log-writer", daemon=True)
        self._thread.start()
        _open_logs.add(self)

    @property
    def waiting(self) -> int:
        """Number of records that wait in memory for the disk."""
        return self._queue.qsize()

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

    def message(self, record: MessageRecord) -> None:
        """Queue the record of a message."""
        self._put(self._file.message, record)

    def close(
        self,
        status: str = "finished",
        exit_code: int = OK,
        summary: Mapping[str, Json] | None = None,
        report: Callable[[str], None] | None = None,
    ) -> None:
        """Write all queued records and ``session_end``, and close the file. Later calls do nothing.

        Args:
            status: How the session ended, in a word or a sentence.
            summary: More values for ``session_end`` (overruns, drops, ...), as JSON values.
            report: Called with the progress, a sentence, every few seconds.

        Raises:
            Sim2RealError: A record could not be written, or the disk has taken no data for a minute.
        """
        # Close once: the interpreter's exit can call this at the same time.
        with self._lock:
            if self._closed:
                return
            self._closed = True
        _open_logs.discard(self)
        # Wait for the queue, then write the end of the session.
        self._queue.put(None)
        self._wait(report)
        if self._error is None:
            end = {**(summary or {}), "status": status, "exit_code": exit_code}
            try:
                self._file.finish(end)
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
            # Raise the exception that left the block, with this one as a note.
            error.add_note(str(failure))

    def _put(self, write: Callable[..., None], *arguments: Any) -> None:
        if self._error is not None:
            raise self._failure() from self._error
        if self._closed:
            raise Sim2RealError(f"the log {self.path} is closed")
        if self._failed is not None:
            raise self._failed
        self._queue.put((write, arguments))
        if self.waiting > self._most_waiting:
            self._failed = Sim2RealError(
                f"{self.waiting:,} records wait in memory, as the disk is too slow for the log {self.path}",
                hint="the log holds every record until now; record fewer or smaller outputs, at a lower rate, close "
                "other programs on this machine, or write to a faster, local disk",
            )

    def _wait(self, report: Callable[[str], None] | None) -> None:
        """Wait until the writer has written the queue, as long as it makes progress."""
        done, silent_s = self._done, 0.0
        for waits in itertools.count(1):
            self._thread.join(WAIT_S)
            if not self._thread.is_alive():
                return
            silent_s = silent_s + WAIT_S if self._done == done else 0.0
            done, left = self._done, self.waiting
            if silent_s > STUCK_S:
                raise Sim2RealError(
                    f"the disk took no data for {STUCK_S:.0f} s: the log {self.path} has no end, "
                    f"{left:,} records are lost",
                    hint="the written part of the log can be read; write logs to a local disk",
                )
            if report is not None and left and waits % REPORT_WAITS == 0:
                report(f"writing the log: {left:,} records wait")

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
            flush_at = time.monotonic() + FLUSH_PERIOD_S
            sync_at = time.monotonic() + SYNC_PERIOD_S
            while True:
                with contextlib.suppress(queue.Empty):
                    item = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
                    if item is None:
                        return
                    write, arguments = item
                    write(*arguments)
                    self._done += 1
                # Flush after each period, so that a crash costs little data; sync less often, as it takes longer.
                if (now := time.monotonic()) >= flush_at:
                    self._file.flush()
                    flush_at = now + FLUSH_PERIOD_S
                    if now >= sync_at:
                        self._file.sync()
                        sync_at = now + SYNC_PERIOD_S
                    self._done += 1
        except BaseException as error:
            self._error = error


_open_logs: set[McapRecorder] = set()


@atexit.register
def close_open_logs() -> None:
    """Close the logs that are still open, as ``aborted``; called when the interpreter or a command ends."""
    for recorder in list(_open_logs):
        with contextlib.suppress(Sim2RealError):  # nobody could read the error any more
            recorder.close("aborted", ERROR)


def _snapshot(node: str, output: PyTree, expected: dict[str, None]) -> list[PyTree]:
    """Return the leaves of an output; writable numpy arrays are copied, because the caller may change them."""
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
