"""Writes the file of one session, in an order that keeps crashed sessions readable. For one thread at a time."""

from __future__ import annotations

import mimetypes
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import MessageRecord, StepRecord, named_leaves
from sim2real.log import metadata as document
from sim2real.log.cdr import CdrField, Layout, text
from sim2real.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TEXT,
    EVENTS_TOPIC,
    JointSource,
    Topic,
    input_topic,
    joint_source,
    output_topic,
    step_topic,
    unique_names,
)
from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    import numpy.typing as npt

LIBRARY = "sim2real"
# Small, so that reading a range decompresses little, and a damaged byte costs little data.
CHUNK_BYTES = 64 * 1024


@dataclass
class _Node:
    """The topics of one node.

    Attributes:
        filled: Indices of the output's leaves with elements; empty leaves are not written.
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

    Attributes:
        counts: Topic -> number of messages written.

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
        self.counts: dict[str, int] = {}
        self._nodes = _nodes(outputs, joint_states, units or {})
        self._inputs = _inputs(inputs, self._nodes)
        self._topics = self._all_topics()
        self._channels: dict[str, int] = {}
        self._epoch_ns = 0
        self._start_monotonic_ns = 0
        self._early_events: list[tuple[int, int | None, int, str, str]] = []
        # Encode the metadata before the file exists, so that an error leaves no file.
        session = document.encode(document.SESSION, metadata)
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
            self._writer.add_metadata(document.SESSION, session)
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
        self._epoch_ns, self._start_monotonic_ns = epoch_ns, monotonic_ns
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
        # Write the definitions also before the first chunk, so that the loss of that chunk does not lose the others.
        self._stream.write(loose.end())
        for event in self._early_events:
            self.event(*event)

    def step(self, record: StepRecord, leaves: Sequence[npt.ArrayLike]) -> None:
        """Write a step, its output and its joint states."""
        # Refuse a node or an output that the session did not announce.
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

    def event(self, monotonic_ns: int, ticks: int | None, level: int, kind: str, message: str) -> None:
        """Write an event.

        Args:
            monotonic_ns: Time of the event on the monotonic clock [ns].
            ticks: Time on a simulated clock [us from the episode's start]; None: use ``monotonic_ns``.
            level: Level as in ROS: 20 information, 30 warning, 40 error, 50 fatal.
        """
        topic = self._topics[-1]
        if not self._channels:
            self._early_events.append((monotonic_ns, ticks, level, kind, message))
            return
        # Times before the episode's start are negative, which the wall clock allows.
        passed_ns = monotonic_ns - self._start_monotonic_ns if ticks is None else 1000 * ticks
        time_ns = self._epoch_ns + passed_ns
        stamp = [
            CdrField("sec", np.dtype("<i4")),
            CdrField("nanosec", np.dtype("<u4")),
            CdrField("level", np.dtype("u1")),
        ]
        texts = [text(kind), text(message), text(""), text("")]
        layout = Layout([*stamp, *texts, CdrField("line", np.dtype("<u4"))])
        payload = layout.pack((time_ns // 1_000_000_000, time_ns % 1_000_000_000, level, 0))
        self._add(topic, payload, self.counts.get(topic.name, 0), time_ns, time_ns)

    def flush(self) -> None:
        """Pass the written records to the operating system, so that they survive the end of this process."""
        self._writer.flush()

    def sync(self) -> None:
        """Wait until the flushed records are on the disk, so that they survive a loss of power."""
        os.fsync(self._stream.fileno())

    def finish(self, end: Mapping[str, Json]) -> None:
        """Write ``session_end`` and the index, and close."""
        self._writer.flush()
        self._writer.add_metadata(document.SESSION_END, document.encode(document.SESSION_END, end))
        self._writer.finish()
        self._stream.flush()
        self.sync()
        self._stream.close()

    def abandon(self) -> None:
        """Close the file without its end."""
        with suppress(OSError):
            self._stream.close()

    def _all_topics(self) -> list[Topic]:
        """Return the topics of all channels; the topic of events is the last one."""
        topics = [t for node in self._nodes.values() for t in (node.step, node.output) if t.layout.fields]
        topics += self._inputs.values()
        topics += [node.joints.topic for node in self._nodes.values() if node.joints is not None][:1]
        events = Topic(EVENTS_TOPIC, EVENTS_SCHEMA, EVENTS_TEXT, Layout(()), {"role": "events"})
        return [*topics, events]

    def _add(self, topic: Topic, payload: bytes, sequence: int, log_time: int, publish_time: int) -> None:
        channel = self._channels.get(topic.name)
        if channel is None:
            raise Sim2RealError("the log got data before the episode's start", hint="call start() first")
        self._writer.add_message(channel, log_time, payload, publish_time, sequence)
        self.counts[topic.name] = self.counts.get(topic.name, 0) + 1


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
