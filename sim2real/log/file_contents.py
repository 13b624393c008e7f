"""Reads a log file once from beginning to end, sorts its messages by channel, and decodes them on request."""

import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata

from sim2real.errors import Sim2RealError
from sim2real.log import metadata
from sim2real.log.cdr import Layout
from sim2real.log.records import (
    BROKEN,
    Damage,
    Record,
    chunk_content,
    chunk_records,
    chunk_times,
    cut_before_session,
    opened,
    parsed,
    records,
)
from sim2real.log.session_file import LIBRARY
from sim2real.types import Json

# Bytes in a message record before its content (opcode, length), and before the message's own data (channel, sequence,
# log time, publish time).
_PREFIX_BYTES, _DATA_AT = 9, 31
_MESSAGE = int(Opcode.MESSAGE)  # a plain number: it is compared for every message
# Role of a channel -> required keys of its metadata.
_ROLES = {
    "step": {"node"},
    "output": {"node", "fields"},
    "input": {"node", "input"},
    "events": set(),
    "joint_states": set(),
}
_DECODED_ROLES = ("step", "output", "input", "events")
_DIGITS = 19


@dataclass(frozen=True)
class Range:
    """A half-open time range.

    Attributes:
        start_s: Its start [s from the episode's start]; None: no limit.
        end_s: Its exclusive end [s]; None: no limit.
    """

    start_s: float | None = None
    end_s: float | None = None

    def log_times(self, epoch_ns: int) -> tuple[int, int]:
        """Return start and end in log time [ns]."""
        begin = 0 if self.start_s is None else max(0, epoch_ns + round(self.start_s * 1e6) * 1000)
        end = 2**63 if self.end_s is None else max(0, epoch_ns + round(self.end_s * 1e6) * 1000)
        return begin, end


@dataclass
class Contents:
    """The content of a log file.

    Attributes:
        library: The library that wrote the file, according to its header.
        session: The session's metadata; None if damaged.
        end: The metadata written at the session's end; None after a crash.
        attachments: File name -> content.
        epoch_ns: Wall clock at the episode's time 0 [ns]; 0 if the episode never started.
        channels: Channel number -> channel.
        messages: Channel number -> message records, in the order of the file; empty if no chunk was opened.
        indexed: Channel number -> number of messages, according to the chunks' indices.
        last_log_time: Latest log time of all chunks [ns].
        damage: The unreadable places.
    """

    library: str = ""
    session: dict[str, Json] | None = None
    end: dict[str, Json] | None = None
    attachments: dict[str, bytes] = field(default_factory=dict)
    epoch_ns: int = 0
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, list[bytes]] = field(default_factory=dict)
    indexed: dict[int, int] = field(default_factory=dict)
    chunks: int = 0
    last_log_time: int = 0
    damage: Damage = field(default_factory=Damage)

    def with_role(self, role: str) -> dict[int, Channel]:
        """Return the channels with a role: ``step``, ``output``, ``input``, ``events`` or ``joint_states``."""
        return {number: c for number, c in self.channels.items() if c.metadata["role"] == role}

    def columns(self, channel: int, layout: Layout, span: Range) -> np.ndarray:
        """Decode the messages of a channel, whose type has a fixed size.

        Returns:
            A structured array, shape ``(N,)``, ordered by sequence: ``sequence``, ``log_time`` and ``publish_time``
            [ns], and ``data`` with the fields of the message.
        """
        # Decode all messages at once: record header and data have a fixed size.
        dtype = np.dtype(
            {
                "names": ["sequence", "log_time", "publish_time", "data"],
                "formats": ["<u4", "<u8", "<u8", layout.dtype],
                "offsets": [11, 15, 23, _DATA_AT],
                "itemsize": _DATA_AT + layout.size,
            }
        )
        messages = self.messages[channel]
        if any(len(m) != dtype.itemsize for m in messages):
            raise Sim2RealError(f"topic {self.channels[channel].topic} holds messages that do not fit its own fields")
        rows = np.frombuffer(b"".join(messages), dtype)
        # Select the range, and sort by sequence, as threads can write out of order.
        begin, end = span.log_times(self.epoch_ns)
        rows = rows[(rows["log_time"] >= begin) & (rows["log_time"] < end)]
        return rows[np.argsort(rows["sequence"], kind="stable")]

    def payloads(self, channel: int, span: Range) -> list[tuple[int, bytes]]:
        """Return log time [ns] and encoded bytes of a channel's messages within a range."""
        begin, end = span.log_times(self.epoch_ns)
        messages = [(int.from_bytes(m[15:23], "little"), m[_DATA_AT:]) for m in self.messages[channel]]
        return [(time, payload) for time, payload in messages if begin <= time < end]


def walk(path: str | Path, span: Range | None = None) -> Contents:
    """Read a log file once.

    Args:
        span: Chunks in this range are opened for their messages; None: no chunk is opened.

    Raises:
        Sim2RealError: When the file is missing, not an MCAP file, not a log of sim2real, or cut off before the end of
            its session metadata.
    """
    contents = Contents()
    with readable_errors(path), opened(path) as data:
        # Count indices, open chunks in the range, and read metadata and attachments.
        for record in records(data, contents.damage):
            if record.opcode == Opcode.MESSAGE_INDEX:
                channel = data[record.start] | data[record.start + 1] << 8
                contents.indexed[channel] = contents.indexed.get(channel, 0) + (record.end - record.start - 6) // 16
            else:
                take(contents, data, record, span)
    # Without the session's metadata, find the reason.
    if contents.session is None:
        if contents.library not in ("", LIBRARY):
            raise Sim2RealError(
                f"{path} is an MCAP file of {contents.library!r}, not a log of sim2real",
                hint="record with `sim2real record`, or convert it",
            )
        if not contents.chunks:
            raise cut_before_session(path)
        contents.damage.skip("the session's metadata")
    return contents


@contextmanager
def readable_errors(path: str | Path) -> Iterator[None]:
    """Convert the exceptions that damaged bytes cause in the block into an error about the file.

    Raises:
        Sim2RealError: When the block raised one of them.
    """
    try:
        yield
    except Sim2RealError:
        raise
    except BROKEN as error:
        raise Sim2RealError(
            f"the log {path} is damaged: {type(error).__name__}: {error}",
            hint="`sim2real log recover FILE` saves the readable part, or record again",
        ) from error


def take(contents: Contents, data: mmap.mmap | bytes, record: Record, span: Range | None) -> None:
    """Add a record to the contents; of a chunk in the range its messages."""
    if record.opcode == Opcode.CHUNK:
        _take_chunk(contents, data, record, span)
    else:
        _take_other(contents, data, record)


def _take_chunk(contents: Contents, data: mmap.mmap | bytes, record: Record, span: Range | None) -> None:
    contents.chunks += 1
    first, last = chunk_times(data, record)
    contents.last_log_time = max(contents.last_log_time, last)
    if span is None:
        return
    begin, end = span.log_times(contents.epoch_ns)
    # Open the first chunk always: it repeats the channels' definitions with a checksum.
    if contents.chunks > 1 and contents.channels and (last < begin or first >= end):
        return
    content = chunk_content(data, record, contents.damage)
    messages = contents.messages
    for opcode, start, end in chunk_records(content):
        if opcode == _MESSAGE:
            channel = content[start] | content[start + 1] << 8
            if channel in messages:
                messages[channel].append(content[start - _PREFIX_BYTES : end])
        elif opcode == Opcode.CHANNEL:
            _take_channel(contents, parsed(Channel, content, Record(opcode, start, end), contents.damage))


def _take_channel(contents: Contents, channel: Channel | None) -> None:
    metadata_of = {} if channel is None else channel.metadata
    needed, epoch_ns = _ROLES.get(metadata_of.get("role", "")), metadata_of.get("epoch_ns", "")
    if channel is None or needed is None or not needed <= set(metadata_of):
        return
    if epoch_ns.isascii() and epoch_ns.isdigit() and len(epoch_ns) <= _DIGITS:
        contents.channels[channel.id] = channel
        contents.epoch_ns = int(epoch_ns)
        if metadata_of["role"] in _DECODED_ROLES:
            contents.messages.setdefault(channel.id, [])


def _take_other(contents: Contents, data: mmap.mmap | bytes, record: Record) -> None:
    if record.opcode == Opcode.CHANNEL:
        _take_channel(contents, parsed(Channel, data, record, contents.damage))
    elif record.opcode == Opcode.HEADER and (header := parsed(Header, data, record, contents.damage)) is not None:
        contents.library = header.library
    elif record.opcode == Opcode.ATTACHMENT:
        if (attachment := parsed(Attachment, data, record, contents.damage)) is not None:
            contents.attachments[attachment.name] = attachment.data
    elif record.opcode == Opcode.METADATA and (entry := parsed(Metadata, data, record, contents.damage)) is not None:
        if entry.name == metadata.SESSION:
            contents.session = metadata.decode(entry.metadata)
        elif entry.name == metadata.SESSION_END:
            contents.end = metadata.decode(entry.metadata)
