"""The records of an MCAP file, whole or damaged or made to harm: from the first byte on, past whatever is broken."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

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
# LZ4 cannot pack tighter than 255 to 1. What claims to is no log, and unpacking it would fill the memory.
_TIGHTEST = 256
# Chunks hold a page of their own at least, however well they are packed.
_SMALL_BYTES = 64 * 1024
# Records stand side by side. Where the lengths in a file make them overlap, reading it could take time without end.
_MOST_READ = 4
# What a record that is cut or bent raises while it is parsed, and what does not fit together afterwards.
BROKEN = (
    *(McapError, struct.error, zlib.error, ValueError, LookupError, TypeError),
    *(AttributeError, ArithmeticError, MemoryError, RecursionError),
)


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

    Raises:
        Sim2RealError: When the records overlap, so that there is no end to them.
    """
    position = trusted = len(MCAP0_MAGIC)
    read = 0
    while position < len(data):
        record = _record(data, position)
        if record is not None:
            read += record.end - position
            if read > _MOST_READ * len(data):
                raise Sim2RealError("the records of the file overlap: no recorder wrote it")
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
        return _decompressed(Chunk.read(stream_of(data, record)))
    except Exception as error:  # every decompressor has errors of its own
        damage.skipped.append(f"a chunk of {record.end - record.start} bytes at {record.start} ({error})")
        return b""


def chunk_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the records in a chunk's content, without reading theirs.

    These are what `Record` holds, but as plain tuples: there is one for each message of a log.

    Raises:
        ValueError: When they do not fill it.
    """
    position, size, unpack = 0, len(content), _PREFIX.unpack_from
    while position < size:
        start = position + _PREFIX.size
        opcode, length = unpack(content, position) if start <= size else (0, size)
        position = start + length
        if position > size:
            raise ValueError("the records in a chunk do not fill it")
        yield opcode, start, position


def parsed(kind: type[Any], data: mmap.mmap | bytes, record: Record, damage: Damage) -> Any | None:
    """Return a record's content as an ``mcap.records`` class, or None where it is damaged."""
    try:
        return kind.read(stream_of(data, record))
    except BROKEN as error:
        damage.skipped.append(f"a {kind.__name__.lower()} record at {record.start} ({error})")
        return None


def stream_of(data: mmap.mmap | bytes, record: Record) -> ReadDataStream:
    """Return a record's content as what ``mcap.records`` classes read."""
    return ReadDataStream(BytesIO(data[record.start : record.end]))


def _record(data: mmap.mmap, position: int) -> Record | None:
    """Return the record at a position, or None if there is no whole and plausible one."""
    start = position + _PREFIX.size
    if start > len(data):
        return None
    opcode, length = _PREFIX.unpack_from(data, position)
    end = start + length
    if end > len(data) or not opcode:
        return None
    # Most of a file is chunks and their indices, whose lengths can be checked; a bent opcode must not end the reading.
    if opcode == _MESSAGE_INDEX:
        plausible = length >= 6 and length == 6 + _INDEX_BYTES.unpack_from(data, start)[0]
    elif opcode == _CHUNK:
        plausible = _is_chunk(data, start, length)
    elif opcode > _DATA_END:
        # Somebody's own (from 0x80 on), or of a later format: to be skipped, if it is not a chunk with a bent opcode.
        plausible = _begins_record(data, end) and not _is_chunk(data, start, length)
    else:
        plausible = opcode != _DATA_END or length == 4
    return Record(opcode, start, end) if plausible else None


def _begins_record(data: mmap.mmap, position: int) -> bool:
    """Whether a record can begin at a position, or the file ends there."""
    if position + _PREFIX.size > len(data):
        return position == len(data)
    opcode, length = _PREFIX.unpack_from(data, position)
    return opcode > 0 and position + _PREFIX.size + length <= len(data)


def _is_chunk(data: mmap.mmap, start: int, length: int) -> bool:
    if length < 40:
        return False
    name = int.from_bytes(data[start + 28 : start + 32], "little")
    if 40 + name > length:
        return False
    return length == 40 + name + int.from_bytes(data[start + 32 + name : start + 40 + name], "little")


def _decompressed(chunk: Chunk) -> bytes:
    """Return a chunk's content; at no time more than it claims, and it may not claim more than there can be."""
    size = chunk.uncompressed_size
    if size > _TIGHTEST * len(chunk.data) + _SMALL_BYTES:
        raise ValueError(f"it claims to hold {size} bytes: more than can be packed into {len(chunk.data)}")
    if chunk.compression == "lz4":
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        import zstandard

        content = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "":
        content = chunk.data
    else:
        raise ValueError(f"its compression {chunk.compression!r} is unknown")
    if len(content) != size:
        raise ValueError(f"it holds other than the {size} bytes that it claims")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ValueError("its checksum differs")
    return content


def _next_landmark(data: mmap.mmap, position: int) -> int | None:
    """Return where the next plausible chunk or end of a session begins at or after a position, or None."""
    for match in _LANDMARK.finditer(data, position):
        begin = match.start() - (_CHUNK_NAME_AT if match["chunk"] else _METADATA_NAME_AT)
        kind = Opcode.CHUNK if match["chunk"] else Opcode.METADATA
        if begin >= position and (record := _record(data, begin)) is not None and record.opcode == kind:
            return begin
    return None
