"""Reads logs, whole, cut or damaged, as episodes with the original names and shapes; also while they are written."""

from __future__ import annotations

import json
import mmap
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode, Messages, Steps
from sim2real.log.cdr import Layout
from sim2real.log.schema import MESSAGE_LAYOUT, STEP_LAYOUT, layout_of_fields, units_of_fields
from sim2real.log.session import SESSION, SESSION_END, decode
from sim2real.log.writer import LIBRARY
from sim2real.types import Json

_PREFIX = struct.Struct("<BQ")
# Plain integers: they compare faster than enum members, and every record of a chunk is compared.
_MESSAGE, _CHANNEL = int(Opcode.MESSAGE), int(Opcode.CHANNEL)
_BEGIN = len(MCAP0_MAGIC)
# Sizes in a message record [bytes]: opcode and length; then channel, sequence and two times.
_MESSAGE_AT, _DATA_AT = 9, 31
# After damage, reading resumes at a chunk or at the session's end. The search looks for the name of the chunk's
# compression, which comes after the prefix, two times, a size and a checksum, or for the name of the session's end.
_LANDMARK = re.compile(rb"(?P<chunk>\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)|\x0b\x00\x00\x00session_end")
_CHUNK_NAME_AT, _METADATA_NAME_AT = 37, 9
# Role of a channel -> required keys of its metadata; joint states repeat the outputs and are not decoded.
_ROLES = {"step": {"node"}, "output": {"node", "fields"}, "input": {"node", "input"}, "joint_states": set[str]()}
_ALL = 0, 2**63
"""All times of a log [ns]."""


class TruncatedLogWarning(UserWarning):
    """The log is incomplete: its session crashed, or a part of the file is unreadable. The rest is read."""


class _Record(NamedTuple):
    opcode: int
    start: int  # of the record's content in the file
    end: int


@dataclass
class _Contents:
    """The content of a log file."""

    library: str = ""  # name of the library that wrote the file, from its header
    session: dict[str, Json] | None = None  # the session's metadata; None if damaged
    end: dict[str, Json] | None = None  # the metadata written at the session's end; None after a crash
    attachments: dict[str, int] = field(default_factory=dict)  # name -> size [bytes]
    epoch_ns: int = 0  # wall clock at the episode's time 0; 0 if the episode never started
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, list[bytes]] = field(default_factory=dict)  # messages of each channel, in the order of the file
    indexed: dict[int, int] = field(default_factory=dict)  # number of messages, according to the chunks' indices
    chunks: int = 0
    last_log_time: int = 0  # first and last log time of all chunks [ns]
    skipped: list[str] = field(default_factory=list)  # descriptions of unreadable parts

    def with_role(self, role: str) -> dict[int, Channel]:
        """Return the channels with a role: ``step``, ``output`` or ``input``."""
        return {number: c for number, c in self.channels.items() if c.metadata["role"] == role}

    def columns(self, channel: int, layout: Layout, span: tuple[int, int]) -> np.ndarray:
        """Decode the messages of a channel, whose type has a fixed size.

        Args:
            span: First log time, and end of log times (excluded) [ns].

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
        # Sort by sequence, because threads may write out of order.
        rows = rows[(rows["log_time"] >= span[0]) & (rows["log_time"] < span[1])]
        return rows[np.argsort(rows["sequence"], kind="stable")]

    def take(self, data: mmap.mmap | bytes, record: _Record, opens_chunks: bool = True) -> None:
        """Add a record and, if ``opens_chunks``, the messages of a chunk; note a damaged record."""
        opcode, start, end = record
        try:
            if opcode == Opcode.CHUNK:
                self.chunks += 1
                self.last_log_time = max(self.last_log_time, struct.unpack_from("<Q", data, start + 8)[0])
                if opens_chunks:
                    content, _ = get_chunk_data_stream(Chunk.read(_stream(data, record)), validate_crc=True)
                    self._take_content(content.read(-1))
            elif opcode == Opcode.MESSAGE_INDEX:
                channel = data[start] | data[start + 1] << 8
                self.indexed[channel] = self.indexed.get(channel, 0) + (end - start - 6) // 16
            elif opcode == Opcode.MESSAGE and opens_chunks:  # some tools write messages outside of chunks
                self._take_content(data[start - _MESSAGE_AT : end])
            elif opcode == Opcode.CHANNEL:
                self._take_channel(Channel.read(_stream(data, record)))
            elif opcode == Opcode.HEADER:
                self.library = Header.read(_stream(data, record)).library
            elif opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(_stream(data, record))
                self.attachments[attachment.name] = len(attachment.data)
            elif opcode == Opcode.METADATA:
                entry = Metadata.read(_stream(data, record))
                if entry.name == SESSION:
                    self.session = decode(entry.metadata)
                elif entry.name == SESSION_END:
                    self.end = decode(entry.metadata)
        except Sim2RealError:
            raise
        except Exception as error:  # damaged bytes may raise any exception
            name = Opcode(opcode).name.lower().replace("_", " ")
            self.skipped.append(f"a {name} of {end - start} bytes at {start} ({error})")

    def _take_content(self, content: bytes) -> None:
        """Add the messages and channels of a chunk."""
        position, size = 0, len(content)
        while position < size:
            start = position + _PREFIX.size
            opcode, length = _PREFIX.unpack_from(content, position) if start <= size else (0, size)
            if start + length > size:
                raise ValueError("the records in a chunk do not fill it")
            if opcode == _MESSAGE:
                waiting = self.messages.get(content[start] | content[start + 1] << 8)
                if waiting is not None:
                    waiting.append(content[position : start + length])
            elif opcode == _CHANNEL:
                self._take_channel(Channel.read(_stream(content, _Record(opcode, start, start + length))))
            position = start + length

    def _take_channel(self, channel: Channel) -> None:
        needed, epoch_ns = _ROLES.get(channel.metadata.get("role", "")), channel.metadata.get("epoch_ns", "")
        if needed is None or not needed <= set(channel.metadata) or not re.fullmatch(r"[0-9]{1,19}", epoch_ns):
            return
        self.channels[channel.id] = channel
        self.epoch_ns = int(epoch_ns)
        if channel.metadata["role"] != "joint_states":
            self.messages.setdefault(channel.id, [])


def read_log(path: str | Path, start_s: float | None = None, end_s: float | None = None) -> Episode:
    """Read a log, or a time range of it.

    The readable part of a damaged log is read, with a warning. The episode's metadata has the session's entries and
    ``log``, a dictionary with ``epoch_ns`` (wall clock at time 0), ``session_end`` (None after a crash),
    ``attachments`` (names), ``first_seq`` (node -> number of its first step in the episode, 0 in a complete log),
    ``missing_steps`` (node -> number of lost steps before the last one) and ``skipped`` (descriptions of unreadable
    parts).

    Args:
        start_s: Read steps that end, and messages that arrive, at this time or later [s from the episode's start];
            default: from the start.
        end_s: Read steps and messages before this time [s from the episode's start]; default: to the end.

    Returns:
        The episode. ``seq_in`` is -1 if the consuming step is not in the episode.

    Raises:
        Sim2RealError: The file is missing, no MCAP file, no log of sim2real, or cut off before the end of its session
            metadata.

    Warns:
        TruncatedLogWarning: The session has no end, or a part is unreadable.
    """
    if start_s is not None and end_s is not None and not start_s <= end_s:
        raise UsageError(f"the range begins at {start_s} s, after its end at {end_s} s")
    contents = _walk(path)
    limits = zip((start_s, end_s), _ALL, strict=True)
    begin, end = (ns if s is None else max(0, contents.epoch_ns + round(s * 1e6) * 1000) for s, ns in limits)
    with _readable_errors(path):
        steps, outputs, sequences = _steps_and_outputs(contents, (begin, end))
        messages = _connections(contents, (begin, end), sequences)
        units = _output_units(contents)
    # Steps before the first read step count as lost, unless the range starts later.
    firsts = {node: int(s[0]) for node, s in sequences.items() if len(s)}
    missing = {
        node: int(s[-1]) + 1 - len(s) - (firsts[node] if start_s else 0) for node, s in sequences.items() if len(s)
    }
    _warn(path, contents, missing)
    # Add facts about the log to the session's metadata.
    log_metadata = {
        "epoch_ns": contents.epoch_ns,
        "session_end": contents.end,
        "attachments": list(contents.attachments),
        "first_seq": firsts,
        "missing_steps": missing,
        "skipped": contents.skipped,
    }
    return Episode(
        steps=steps,
        messages=messages,
        outputs=outputs,
        metadata={**(contents.session or {}), "log": log_metadata},
        complete=contents.end is not None,
        units=units,
    )


def read_session(path: str | Path) -> dict[str, Json]:
    """Return the session's metadata, without reading steps and messages.

    Raises:
        Sim2RealError: As ``read_log``, or the metadata is damaged.
    """
    session = _walk(path, opens_chunks=False).session
    if session is None:
        raise Sim2RealError(f"the session metadata of {path} is damaged", hint="read_log still reads the data")
    return session


def summary(path: str | Path) -> dict[str, Json]:
    """Return a summary of a log without decoding messages.

    Returns:
        ``bytes`` (file size), ``chunks`` (their number), ``epoch_ns``, ``duration_s``, ``complete``, ``session`` (None
        if damaged), ``session_end`` (None after a crash), ``attachments`` (name -> size in bytes), ``topics`` (topic ->
        number of messages, according to the chunks' indices) and ``skipped``.

    Raises:
        Sim2RealError: As ``read_log``.
    """
    contents = _walk(path, opens_chunks=False)
    return {
        "bytes": Path(path).stat().st_size,
        "chunks": contents.chunks,
        "epoch_ns": contents.epoch_ns,
        "duration_s": max(0, contents.last_log_time - contents.epoch_ns) / 1e9,
        "complete": contents.end is not None,
        "session": contents.session,
        "session_end": contents.end,
        "attachments": contents.attachments,
        "topics": {c.topic: contents.indexed.get(number, 0) for number, c in contents.channels.items()},
        "skipped": contents.skipped,
    }


class LogTail:
    """Reads the growing end of a log, without effect on the process that writes it.

    Args:
        path: The log, which exists and may be empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._position = 0
        self._contents = _Contents()

    @property
    def ended(self) -> bool:
        """Whether the session has ended in order."""
        return self._contents.end is not None

    @property
    def epoch_ns(self) -> int:
        """Wall clock at the episode's time 0 [ns]."""
        return self._contents.epoch_ns

    def read(self) -> Episode | None:
        """Return the new steps, without messages; None if there is none.

        Raises:
            Sim2RealError: The file is damaged, or is no log of sim2real.
        """
        contents = self._contents
        with open(self.path, "rb") as stream:
            stream.seek(self._position)
            data = stream.read()
        if self._position == 0:
            if len(data) < _BEGIN:
                return None
            if not data.startswith(MCAP0_MAGIC):
                raise Sim2RealError(f"{self.path} is no MCAP file")
        # Take the complete records; the next call reads the rest again.
        position = 0 if self._position else _BEGIN
        with _readable_errors(self.path):
            while (record := _record(data, position)) is not None and record.opcode != Opcode.DATA_END:
                contents.take(data, record)
                position = record.end
            self._position += position
            steps = contents.with_role("step")
            if not any(map(contents.messages.get, steps)):
                return None
            parts, outputs, _ = _steps_and_outputs(contents, _ALL)
            episode = Episode(parts, {}, outputs, contents.session or {}, complete=False, units=_output_units(contents))
        # Keep outputs whose step records are in the next chunk: the writer writes an output before its step.
        counts = {c.metadata["node"]: len(contents.messages[n]) for n, c in steps.items()}
        for number, channel in contents.channels.items():
            waiting = contents.messages.get(number, [])
            whole = counts.get(channel.metadata.get("node", ""), 0) if channel.metadata["role"] == "output" else None
            contents.messages[number] = [] if whole is None else waiting[whole:]
        return episode


# -- steps, outputs and messages


def _output_units(contents: _Contents) -> dict[str, dict[str, str]]:
    """Return node -> field -> unit, for the nodes whose channels have units."""
    channels = contents.with_role("output").values()
    by_node = {c.metadata["node"]: units_of_fields(json.loads(c.metadata["fields"])) for c in channels}
    return {node: units for node, units in by_node.items() if units}


def _steps_and_outputs(
    contents: _Contents, span: tuple[int, int]
) -> tuple[dict[str, Steps], dict[str, dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Return steps, outputs, and the number of each step, by node."""
    output_channels = {c.metadata["node"]: (n, c) for n, c in contents.with_role("output").items()}
    steps, outputs, sequences = {}, {}, {}
    for number, channel in contents.with_role("step").items():
        node = channel.metadata["node"]
        rows = contents.columns(number, STEP_LAYOUT, span)
        outputs[node] = {}
        if node in output_channels:
            number, channel = output_channels[node]
            described = json.loads(channel.metadata["fields"])
            values = contents.columns(number, layout_of_fields(described), span)
            # Keep complete pairs: a step and its output may be in different chunks, one of which may be lost.
            _, in_steps, in_values = np.intersect1d(rows["sequence"], values["sequence"], return_indices=True)
            rows, values = rows[in_steps], values[in_values]
            for entry in described:
                name, shape = entry["original"], (len(rows), *entry["shape"])
                in_payload = name in (values.dtype["data"].names or ())
                outputs[node][name] = (
                    np.ascontiguousarray(values["data"][name]) if in_payload else np.zeros(shape, entry["dtype"])
                )
        # The columns of the step records.
        data = rows["data"]
        steps[node] = Steps(*(np.ascontiguousarray(data[f]) for f in Steps.__dataclass_fields__))
        sequences[node] = np.ascontiguousarray(data["seq"])
    return steps, outputs, sequences


def _connections(
    contents: _Contents, span: tuple[int, int], sequences: Mapping[str, np.ndarray]
) -> dict[tuple[str, str], Messages]:
    """Return the messages of each connection, by (node, input name)."""
    connections = {}
    for number, channel in contents.with_role("input").items():
        node = channel.metadata["node"]
        rows = contents.columns(number, MESSAGE_LAYOUT, span)
        seq_in = rows["data"]["seq_in"]
        in_episode = np.isin(seq_in, sequences.get(node, []))
        # Times are on the wall clock [ns]; convert them to ticks since time 0.
        sent, received = ((rows[f].astype(np.int64) - contents.epoch_ns) // 1000 for f in ("publish_time", "log_time"))
        connections[node, channel.metadata["input"]] = Messages(
            seq_out=np.ascontiguousarray(rows["data"]["seq_out"]),
            seq_in=np.where(in_episode, seq_in, -1),
            sent=sent,
            received=received,
        )
    return connections


def _warn(path: str | Path, contents: _Contents, missing: Mapping[str, int]) -> None:
    """Warn of missing parts of the log; the warning points to the caller of ``read_log``."""
    problems = []
    if contents.end is None:
        problems.append("its session has no end: the process that recorded it crashed or still runs")
    if contents.skipped:
        problems.append(f"unreadable: {'; '.join(contents.skipped)}")
    lost = [f"{count} of node {node!r}" for node, count in missing.items() if count]
    if lost:
        problems.append(f"steps are missing: {', '.join(lost)}")
    if problems:
        warnings.warn(f"the log {path} is not whole: {'. '.join(problems)}", TruncatedLogWarning, stacklevel=3)


# -- records


def _walk(path: str | Path, opens_chunks: bool = True) -> _Contents:
    """Read a log file once.

    Raises:
        Sim2RealError: The file is missing, no MCAP file, no log of sim2real, or cut off before the end of its session
            metadata.
    """
    contents = _Contents()
    with _readable_errors(path), _opened(path) as data:
        for record in _records(data, contents.skipped):
            contents.take(data, record, opens_chunks)
    # If there is no session metadata, find out why.
    if contents.session is None:
        if contents.library not in ("", LIBRARY):
            raise Sim2RealError(
                f"{path} is an MCAP file of {contents.library!r}, not a log of sim2real",
                hint="convert it with `sim2real import FILE`",
            )
        if not contents.chunks:
            raise _cut_before_session(path)
        contents.skipped.append("the session's metadata")
    return contents


@contextmanager
def _readable_errors(path: str | Path) -> Iterator[None]:
    """Convert exceptions that damaged bytes cause in the block to an error about the file."""
    try:
        yield
    except (Sim2RealError, OSError):
        raise
    except Exception as error:
        raise Sim2RealError(
            f"the log {path} is damaged: {type(error).__name__}: {error}",
            hint="record again; `mcap recover` of MCAP's own command-line tool may save the readable part",
        ) from error


@contextmanager
def _opened(path: str | Path) -> Iterator[mmap.mmap]:
    """Map an MCAP file into memory."""
    path = Path(path)
    if not path.is_file():
        names = sorted(p.name for p in path.parent.glob("*.mcap"))
        raise Sim2RealError(
            f"there is no log {path}", hint=f"logs in that folder: {', '.join(names)}" if names else "check the path"
        )
    with open(path, "rb") as stream:
        # An MCAP file starts with its magic bytes.
        magic = stream.read(_BEGIN)
        if len(magic) < _BEGIN and MCAP0_MAGIC.startswith(magic):
            raise _cut_before_session(path)
        if magic != MCAP0_MAGIC:
            raise Sim2RealError(
                f"{path} is no MCAP file",
                hint="`sim2real record` writes logs, and `sim2real import` makes one of a file of another recorder",
            )
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def _cut_before_session(path: str | Path) -> Sim2RealError:
    return Sim2RealError(
        f"the log {path} was cut before the end of its session metadata: it holds no data",
        hint="the recording stopped while it was set up; record again",
    )


def _records(data: mmap.mmap, skipped: list[str]) -> Iterator[_Record]:
    """Yield the records of the data section without reading their content.

    The length of each record leads to the next record. If a length is damaged, reading resumes at the next bytes that
    look like a chunk or the session's end, and the gap is noted in ``skipped``.
    """
    position = trusted = _BEGIN
    while position < len(data):
        record = _record(data, position)
        if record is not None:
            yield record
            position = record.end
            if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                trusted = position
            elif record.opcode == Opcode.DATA_END:
                return
            continue
        # A damaged length may lead past good chunks: search from the end of the last record that is surely complete.
        resume = _next_landmark(data, trusted)
        if resume is None:
            return
        skipped.append(f"{resume - trusted} bytes at {trusted}")
        position, trusted = resume, resume + 1


def _record(data: mmap.mmap | bytes, position: int) -> _Record | None:
    """Return the record at a position; None if there is no complete and plausible one."""
    start = position + _PREFIX.size
    if start > len(data):
        return None
    opcode, length = _PREFIX.unpack_from(data, position)
    end = start + length
    if end > len(data) or not opcode:
        return None
    # Check the lengths inside of chunks and message indices, which are most of a file; check the opcode of other
    # records.
    if opcode == Opcode.MESSAGE_INDEX:
        plausible = length >= 6 and length == 6 + int.from_bytes(data[start + 2 : start + 6], "little")
    elif opcode == Opcode.CHUNK:
        plausible = _is_chunk(data, start, length)
    elif opcode > Opcode.DATA_END:
        # Accept a private record (from 0x80 on) or one of a later format, but no chunk with a damaged opcode.
        plausible = _begins_record(data, end) and not _is_chunk(data, start, length)
    else:
        plausible = opcode != Opcode.DATA_END or length == 4
    return _Record(opcode, start, end) if plausible else None


def _begins_record(data: mmap.mmap | bytes, position: int) -> bool:
    """Return whether a record can begin at a position, or the file ends there."""
    if position + _PREFIX.size > len(data):
        return position == len(data)
    opcode, length = _PREFIX.unpack_from(data, position)
    return opcode > 0 and position + _PREFIX.size + length <= len(data)


def _is_chunk(data: mmap.mmap | bytes, start: int, length: int) -> bool:
    """Return whether the lengths inside a record's content are those of a chunk."""
    if length < 40:
        return False
    name = int.from_bytes(data[start + 28 : start + 32], "little")
    if 40 + name > length:
        return False
    return length == 40 + name + int.from_bytes(data[start + 32 + name : start + 40 + name], "little")


def _next_landmark(data: mmap.mmap, position: int) -> int | None:
    """Return the position of the next plausible chunk or session's end at or after a position; None without any."""
    for match in _LANDMARK.finditer(data, position):
        begin = match.start() - (_CHUNK_NAME_AT if match["chunk"] else _METADATA_NAME_AT)
        kind = Opcode.CHUNK if match["chunk"] else Opcode.METADATA
        if begin >= position and (record := _record(data, begin)) is not None and record.opcode == kind:
            return begin
    return None


def _stream(data: mmap.mmap | bytes, record: _Record) -> ReadDataStream:
    """Return a record's content as the stream that classes of ``mcap.records`` read."""
    return ReadDataStream(BytesIO(data[record.start : record.end]))
