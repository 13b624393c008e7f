"""Reads the records of an MCAP file in order and skips damaged parts; safe against malicious files."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from threading import get_ident
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

from sim2real.errors import Sim2RealError

if TYPE_CHECKING:
    import zstandard

_PREFIX = struct.Struct("<BQ")
_CHUNK_TIMES = struct.Struct("<QQ")
# Plain integers compare faster than enum members, and every record is compared.
_CHUNK, _MESSAGE_INDEX, _DATA_END = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX), int(Opcode.DATA_END)
_INDEX_BYTES = struct.Struct("<2xI")
# After damage, reading resumes at a chunk or at the session's end. The search looks for the name of the chunk's
# compression, which comes after the prefix, two times, a size and a checksum, or for the name of the session's end.
_LANDMARK = re.compile(rb"(?P<chunk>\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)|\x0b\x00\x00\x00session_end")
_CHUNK_NAME_AT = 37
_METADATA_NAME_AT = _PREFIX.size
# LZ4 compresses at most 255 to 1. A larger claim is false, and decompressing such a chunk could fill the memory.
_MAX_RATIO = 256
# Zstandard has no such limit for equal bytes, as of a black image; this is the limit for such chunks.
_MAX_ZSTD_BYTES = 1 << 28
_BLOCK = 1 << 20
# Up to this size, a chunk can have any ratio of compression.
_SMALL_BYTES = 64 * 1024
# Reading stops after this multiple of the file's size, as overlapping records could repeat without end.
_MAX_READ_RATIO = 4
# Number of unreadable places with a description; a file can have millions.
_MAX_DESCRIBED = 100
# Exceptions of parsing a damaged record, and of using values that do not fit each other.
BROKEN = (
    *(McapError, struct.error, zlib.error, ValueError, LookupError, TypeError),
    *(AttributeError, ArithmeticError, MemoryError, RecursionError),
)


R = TypeVar("R", covariant=True)


class RecordType(Protocol[R]):
    """A class of ``mcap.records``."""

    __name__: str

    def read(self, stream: ReadDataStream, /) -> R:
        """Return the record in a stream."""
        ...


class Record(NamedTuple):
    """A record's opcode, and start and end of its content in the file."""

    opcode: int
    start: int
    end: int


@dataclass
class Damage:
    """The unreadable places of a file.

    Attributes:
        skipped: Descriptions of the places, in the order of the file; the last one counts those beyond the first 100.
        cut: Whether the file ends before the end of its data section.
    """

    skipped: list[str] = field(default_factory=list)
    cut: bool = False
    count: int = 0

    def skip(self, description: str) -> None:
        """Add the description of an unreadable place."""
        self.count += 1
        beyond = self.count - _MAX_DESCRIBED
        self.skipped[_MAX_DESCRIBED:] = [f"{beyond} more places"] if beyond > 0 else []
        if beyond <= 0:
            self.skipped.append(description)


@contextmanager
def opened(path: str | Path) -> Iterator[mmap.mmap]:
    """Map an MCAP file into memory.

    Raises:
        Sim2RealError: When there is no such file, or it is not an MCAP file.
    """
    path = Path(path)
    if not path.is_file():
        names = sorted(p.name for p in path.parent.glob("*.mcap"))
        raise Sim2RealError(
            f"there is no log {path}", hint=f"logs in that folder: {', '.join(names)}" if names else "check the path"
        )
    with open(path, "rb") as stream:
        # An MCAP file starts with its magic bytes.
        magic = stream.read(len(MCAP0_MAGIC))
        if len(magic) < len(MCAP0_MAGIC) and MCAP0_MAGIC.startswith(magic):
            raise cut_before_session(path)
        if magic != MCAP0_MAGIC:
            raise Sim2RealError(f"{path} is no MCAP file", hint="logs are recorded with `sim2real record`")
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def cut_before_session(path: str | Path) -> Sim2RealError:
    """Return the error for a log that was cut off before its first data."""
    return Sim2RealError(
        f"the log {path} was cut before the end of its session metadata: it holds no data",
        hint="the recording stopped while it was set up; record again",
    )


def records(data: mmap.mmap, damage: Damage) -> Iterator[Record]:
    """Yield the records of the data section without reading their content.

    The length of each record leads to the next one. If a length is damaged, reading resumes at the next bytes that look
    like a chunk or the session's end.

    Raises:
        Sim2RealError: When records overlap.
    """
    position = trusted = len(MCAP0_MAGIC)
    read = 0
    while position < len(data):
        record = _record(data, position)
        if record is not None:
            read += record.end - position
            if read > _MAX_READ_RATIO * len(data):
                raise Sim2RealError("the records of the file overlap, which no recorder writes")
            yield record
            position = record.end
            if record.opcode in (_CHUNK, _MESSAGE_INDEX):
                trusted = position
            elif record.opcode == _DATA_END:
                return
            continue
        # A damaged length can lead past good chunks: search from the end of the last record that is surely whole.
        resume = _next_landmark(data, trusted)
        if resume is None:
            break
        damage.skip(f"{resume - trusted} bytes at {trusted}")
        position, trusted = resume, resume + 1
    damage.cut = True


def whole_records(data: bytes, position: int) -> Iterator[Record]:
    """Yield the records of the end of a growing file from a position on, up to the first one that is not whole yet."""
    while position + _PREFIX.size <= len(data):
        opcode, length = _PREFIX.unpack_from(data, position)
        start, position = position + _PREFIX.size, position + _PREFIX.size + length
        if position > len(data) or opcode == _DATA_END:
            return
        yield Record(opcode, start, position)


def chunk_times(data: mmap.mmap | bytes, record: Record) -> tuple[int, int]:
    """Return the first and the last log time in a chunk [ns]."""
    first, last = _CHUNK_TIMES.unpack_from(data, record.start)
    return first, last


def chunk_content(data: mmap.mmap | bytes, record: Record, damage: Damage) -> bytes:
    """Return the content of a chunk, decompressed and checked; empty if it is damaged."""
    try:
        return _decompressed(Chunk.read(stream_of(data, record)))
    except Exception as error:  # decompressors have their own exceptions
        damage.skip(f"a chunk of {record.end - record.start} bytes at {record.start} ({error})")
        return b""


def chunk_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the records in a chunk's content, without reading their content.

    The tuples have the fields of ``Record``; plain tuples are faster, and there is one for each message.

    Raises:
        ValueError: When the records' lengths do not add up to the content's.
    """
    position, size, unpack = 0, len(content), _PREFIX.unpack_from
    while position < size:
        start = position + _PREFIX.size
        opcode, length = unpack(content, position) if start <= size else (0, size)
        position = start + length
        if position > size:
            raise ValueError("the records in a chunk do not fill it")
        yield opcode, start, position


def parsed(kind: RecordType[R], data: mmap.mmap | bytes, record: Record, damage: Damage) -> R | None:
    """Return a record parsed by a class of ``mcap.records``; None if it is damaged."""
    try:
        return kind.read(stream_of(data, record))
    except BROKEN as error:
        damage.skip(f"a {kind.__name__.lower()} record at {record.start} ({error})")
        return None


def stream_of(data: mmap.mmap | bytes, record: Record) -> ReadDataStream:
    """Return a record's content as the stream that classes of ``mcap.records`` read."""
    return ReadDataStream(BytesIO(data[record.start : record.end]))


def _record(data: mmap.mmap, position: int) -> Record | None:
    """Return the record at a position; None if there is no complete and plausible one."""
    start = position + _PREFIX.size
    if start > len(data):
        return None
    opcode, length = _PREFIX.unpack_from(data, position)
    end = start + length
    if end > len(data) or not opcode:
        return None
    # Check the lengths inside of chunks and message indices, which are most of a file; check the opcode of the others.
    if opcode == _MESSAGE_INDEX:
        plausible = length >= 6 and length == 6 + _INDEX_BYTES.unpack_from(data, start)[0]
    elif opcode == _CHUNK:
        plausible = _is_chunk(data, start, length)
    elif opcode > _DATA_END:
        # Accept a private record (from 0x80 on) or one of a later format, but no chunk with a damaged opcode.
        plausible = _begins_record(data, end) and not _is_chunk(data, start, length)
    else:
        plausible = opcode != _DATA_END or length == 4
    return Record(opcode, start, end) if plausible else None


def _begins_record(data: mmap.mmap, position: int) -> bool:
    """Return whether a record can begin at a position, or the file ends there."""
    if position + _PREFIX.size > len(data):
        return position == len(data)
    opcode, length = _PREFIX.unpack_from(data, position)
    return opcode > 0 and position + _PREFIX.size + length <= len(data)


def _is_chunk(data: mmap.mmap, start: int, length: int) -> bool:
    """Return whether the lengths inside a record's content are those of a chunk."""
    if length < 40:
        return False
    name = int.from_bytes(data[start + 28 : start + 32], "little")
    if 40 + name > length:
        return False
    return length == 40 + name + int.from_bytes(data[start + 32 + name : start + 40 + name], "little")


def _decompressed(chunk: Chunk) -> bytes:
    """Return a chunk's content, without decompressing more than its claimed size; check size and checksum."""
    # Refuse a false size before decompressing.
    size = chunk.uncompressed_size
    limit = _MAX_RATIO * len(chunk.data) + _SMALL_BYTES
    if size > (max(limit, _MAX_ZSTD_BYTES) if chunk.compression == "zstd" else limit):
        raise ValueError(f"it claims to hold {size} bytes: more than can be packed into {len(chunk.data)}")
    if chunk.compression == "lz4":
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        content = b"".join(islice(_blocks(_zstd(get_ident()).stream_reader(chunk.data)), 2 + size // _BLOCK))
    elif chunk.compression == "":
        content = chunk.data
    else:
        raise ValueError(f"its compression {chunk.compression!r} is unknown")
    # Check size and checksum of the content.
    if len(content) != size:
        raise ValueError(f"it holds other than the {size} bytes that it claims")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ValueError("its checksum differs")
    return content


@lru_cache(maxsize=16)
def _zstd(_thread: int) -> zstandard.ZstdDecompressor:
    """Return a thread's decompressor, which takes longer to create than a small chunk takes to decompress."""
    import zstandard

    return zstandard.ZstdDecompressor()


def _blocks(stream: zstandard.ZstdDecompressionReader) -> Iterator[bytes]:
    """Yield the content of a stream in blocks, so that memory grows only with the real content."""
    while block := stream.read(_BLOCK):
        yield block


def _next_landmark(data: mmap.mmap, position: int) -> int | None:
    """Return the position of the next plausible chunk or session's end at or after a position; None without any."""
    for match in _LANDMARK.finditer(data, position):
        begin = match.start() - (_CHUNK_NAME_AT if match["chunk"] else _METADATA_NAME_AT)
        kind = Opcode.CHUNK if match["chunk"] else Opcode.METADATA
        if begin >= position and (record := _record(data, begin)) is not None and record.opcode == kind:
            return begin
    return None
