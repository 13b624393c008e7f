"""Reading a damaged log: from its first byte on, past whatever is broken."""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from sim2real.errors import Sim2RealError

_PREFIX = struct.Struct("<BQ")
_CHUNK_TIMES = struct.Struct("<QQ")
# As plain numbers: they are compared for every record of a file.
_CHUNK, _MESSAGE_INDEX, _DATA_END = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX), int(Opcode.DATA_END)
_INDEX_BYTES = struct.Struct("<2xI")
# What reading can resume at: a chunk, by its compression's name (behind the prefix, two times, a size and a checksum),
# and the session's end, by its own name (behind the prefix).
_LANDMARK = re.compile(rb"(?P<chunk>\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)|\x0b\x00\x00\x00session_end")
_CHUNK_NAME_AT = 37
_METADATA_NAME_AT = _PREFIX.size
# What a record that is cut or bent raises while it is parsed.
_BROKEN = (McapError, struct.error, ValueError)


class Record(NamedTuple):
    """A record's kind and the place of its content in the file."""

    opcode: int
    start: int
    end: int


@dataclass
class Damage:
    """What could not be read.

    Attributes:
        skipped: What is unreadable and where, in words, in the file's order.
        cut: Whether the file ends before its data does.
    """

    skipped: list[str] = field(default_factory=list)
    cut: bool = False


@contextmanager
def opened(path: str | Path) -> Iterator[mmap.mmap]:
    """Map an MCAP file into memory.

    Raises:
        Sim2RealError: When there is no such file, it cannot be read or is no MCAP.
    """
    path = Path(path)
    if not path.is_file():
        found = sorted(p.name for p in path.parent.glob("*.mcap"))
        raise Sim2RealError(
            f"there is no log {path}", hint=f"logs in that folder: {', '.join(found)}" if found else "check the path"
        )
    with open(path, "rb") as stream:
        magic = stream.read(len(MCAP0_MAGIC))
        if len(magic) < len(MCAP0_MAGIC) and MCAP0_MAGIC.startswith(magic):
            raise cut_before_session(path)
        if magic != MCAP0_MAGIC:
            raise Sim2RealError(f"{path} is no MCAP file", hint="logs are recorded with `sim2real record`")
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def cut_before_session(path: str | Path) -> Sim2RealError:
    """Return the error for a log that ends before anything was recorded."""
    return Sim2RealError(
        f"the log {path} was cut before the end of its session metadata: it holds no data",
        hint="the recording stopped while it was set up; record again",
    )


def records(data: mmap.mmap, damage: Damage) -> Iterator[Record]:
    """Yield the records of the data section without reading their content.

    Where the chain of lengths is broken, reading resumes at the next thing that looks like a chunk or a session's end.

    Args:
        data: The file.
        damage: Takes note of what is broken.
    """
    position = trusted = len(MCAP0_MAGIC)
    while position < len(data):
        record = _record(data, position)
        if record is not None:
            yield record
            position = record.end
            if record.opcode in (_CHUNK, _MESSAGE_INDEX):
                trusted = position
            elif record.opcode == _DATA_END:
                return
            continue
        # A bent length may have led here, past good chunks: search from behind the last record that was surely whole.
        resume = _next_landmark(data, trusted)
        if resume is None:
            break
        damage.skipped.append(f"{resume - trusted} bytes at {trusted}")
        position, trusted = resume, resume + 1
    damage.cut = True


def chunk_times(data: mmap.mmap, record: Record) -> tuple[int, int]:
    """Return the first and the last log time in a chunk [ns]."""
    first, last = _CHUNK_TIMES.unpack_from(data, record.start)
    return first, last


def chunk_content(data: mmap.mmap, record: Record, damage: Damage) -> bytes:
    """Return the records in a chunk, decompressed and checked; nothing where it is damaged."""
    try:
        stream, size = get_chunk_data_stream(Chunk.read(_stream(data, record)), validate_crc=True)
        return stream.read(size)
    except Exception as error:  # every decompressor has errors of its own
        damage.skipped.append(_lost_chunk(record, error))
        return b""


def parsed(kind: type[Any], data: mmap.mmap, record: Record, damage: Damage) -> Any | None:
    """Return a record's content as an ``mcap.records`` class, or None where it is damaged."""
    try:
        return kind.read(_stream(data, record))
    except _BROKEN as error:
        damage.skipped.append(f"a {kind.__name__.lower()} record at {record.start} ({error})")
        return None


@dataclass(frozen=True)
class Recovery:
    """What ``recover`` saved.

    Attributes:
        messages: Topic -> messages written.
        skipped: What was unreadable, in words.
        cut: Whether the source ends before its data does.
    """

    messages: Mapping[str, int]
    skipped: tuple[str, ...]
    cut: bool


def recover(source: str | Path, target: str | Path) -> Recovery:
    """Write what is readable of a damaged MCAP file into a new one that every reader opens.

    A session that crashed stays one: the new file has a ``session_end`` only if the old one had.

    Args:
        source: Any MCAP file.
        target: The new file; it must not exist.

    Raises:
        Sim2RealError: When the source is missing or no MCAP file, or the target exists.
    """
    damage = Damage()
    if Path(target).exists():
        raise Sim2RealError(f"{target} exists already", hint="choose another name")
    with opened(source) as data:
        try:
            with open(target, "xb") as stream:
                copier = _Copier(Writer(stream, chunk_size=64 * 1024, compression=CompressionType.LZ4))
                for record in records(data, damage):
                    copier.take(data, record, damage)
                copier.finish()
        except BaseException:
            Path(target).unlink(missing_ok=True)
            raise
    return Recovery(copier.counts, tuple(damage.skipped), damage.cut)


class _Copier:
    """Puts the records of one file into another, with numbers of its own for schemas and channels."""

    def __init__(self, writer: Writer) -> None:
        self.counts: dict[str, int] = {}
        self._writer = writer
        self._header = Header(profile="", library="")
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, tuple[int, str]] = {}

    def take(self, data: mmap.mmap, record: Record, damage: Damage) -> None:
        """Copy a record of the data section."""
        kinds = {
            Opcode.HEADER: Header,
            Opcode.METADATA: Metadata,
            Opcode.ATTACHMENT: Attachment,
            Opcode.SCHEMA: Schema,
            Opcode.CHANNEL: Channel,
        }
        if record.opcode == Opcode.CHUNK:
            try:
                for content in breakup_chunk(Chunk.read(_stream(data, record)), validate_crc=True):
                    self._copy(content)
            except Exception as error:  # every decompressor has errors of its own
                damage.skipped.append(_lost_chunk(record, error))
        elif record.opcode == Opcode.MESSAGE:
            self._copy(Message.read(_stream(data, record), record.end - record.start))
        elif record.opcode in kinds:
            self._copy(parsed(kinds[Opcode(record.opcode)], data, record, damage))

    def finish(self) -> None:
        """Write the index."""
        self._begin()
        self._writer.finish()

    def _begin(self) -> None:
        if not self._started:
            self._started = True
            self._writer.start(profile=self._header.profile, library=self._header.library)

    def _copy(self, record: Any) -> None:
        if isinstance(record, Header):
            self._header = record
            return
        self._begin()
        if isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels and record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id]
            channel = self._writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            self._channels[record.id] = channel, record.topic
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel, topic = self._channels[record.channel_id]
            self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            self.counts[topic] = self.counts.get(topic, 0) + 1


def _lost_chunk(record: Record, error: Exception) -> str:
    return f"a chunk of {record.end - record.start} bytes at {record.start} ({error})"


def _stream(data: mmap.mmap, record: Record) -> ReadDataStream:
    return ReadDataStream(BytesIO(data[record.start : record.end]))


def _record(data: mmap.mmap, position: int) -> Record | None:
    """Return the record at a position, or None if there is no whole and plausible one."""
    start = position + _PREFIX.size
    if start > len(data):
        return None
    opcode, length = _PREFIX.unpack_from(data, position)
    end = start + length
    if end > len(data) or not 0 < opcode <= _DATA_END:
        return None
    # Most of a file is chunks and their indices, whose lengths can be checked; a bent opcode must not end the reading.
    if opcode == _MESSAGE_INDEX:
        plausible = length >= 6 and length == 6 + _INDEX_BYTES.unpack_from(data, start)[0]
    elif opcode == _CHUNK:
        plausible = _is_chunk(data, start, length)
    else:
        plausible = opcode != _DATA_END or length == 4
    return Record(opcode, start, end) if plausible else None


def _is_chunk(data: mmap.mmap, start: int, length: int) -> bool:
    if length < 40:
        return False
    name = int.from_bytes(data[start + 28 : start + 32], "little")
    if 40 + name > length:
        return False
    return length == 40 + name + int.from_bytes(data[start + 32 + name : start + 40 + name], "little")


def _next_landmark(data: mmap.mmap, position: int) -> int | None:
    """Return where the next plausible chunk or end of a session begins at or after a position, or None."""
    for match in _LANDMARK.finditer(data, position):
        begin = match.start() - (_CHUNK_NAME_AT if match["chunk"] else _METADATA_NAME_AT)
        kind = Opcode.CHUNK if match["chunk"] else Opcode.METADATA
        if begin >= position and (record := _record(data, begin)) is not None and record.opcode == kind:
            return begin
    return None
