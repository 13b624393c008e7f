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
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

from sim2real.errors import Sim2RealError

_PREFIX = struct.Struct("<BQ")
_CHUNK_TIMES = struct.Struct("<QQ")
# Plain integers, as comparing with them is faster, and it is done for every record.
_CHUNK, _MESSAGE_INDEX, _DATA_END = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX), int(Opcode.DATA_END)
_INDEX_BYTES = struct.Struct("<2xI")
# After damage, reading resumes at a chunk or at the session's end. A chunk is found by the name of its compression,
# which comes after the prefix, two times, a size and a checksum; the session's end by its name, after the prefix.
_LANDMARK = re.compile(rb"(?P<chunk>\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)|\x0b\x00\x00\x00session_end")
_CHUNK_NAME_AT = 37
_METADATA_NAME_AT = _PREFIX.size
# LZ4 compresses at most 255 to 1. A chunk that claims more is not genuine, and decompressing it could fill the memory.
_TIGHTEST = 256
# Zstandard packs equal bytes without such a limit, as those of a black image; a chunk that claims more is not genuine.
_TIGHTEST_ZSTD_BYTES = 1 << 28
_BLOCK = 1 << 20
# Up to this size, a chunk's uncompressed size is accepted whatever the ratio.
_SMALL_BYTES = 64 * 1024
# Reading stops once this multiple of the file's size was read: records overlap, and might do so without end.
_MOST_READ = 4
# So many unreadable places are described; a file may have millions.
_MOST_DESCRIBED = 100
# What parsing a damaged record may raise, or using values that do not fit each other.
BROKEN = (
    *(McapError, struct.error, zlib.error, ValueError, LookupError, TypeError),
    *(AttributeError, ArithmeticError, MemoryError, RecursionError),
)


class Record(NamedTuple):
    """A record's opcode, and start and end of its content in the file."""

    opcode: int
    start: int
    end: int


@dataclass
class Damage:
    """What could not be read.

    Attributes:
        skipped: Descriptions of what is unreadable and where, in the order of the file; the last one counts the places
            beyond the first hundred.
        cut: Whether the file ends before the end of its data section.
        count: Number of unreadable places.
    """

    skipped: list[str] = field(default_factory=list)
    cut: bool = False
    count: int = 0

    def skip(self, what: str) -> None:
        """Add the description of an unreadable place."""
        self.count += 1
        beyond = self.count - _MOST_DESCRIBED
        self.skipped[_MOST_DESCRIBED:] = [f"{beyond} more places"] if beyond > 0 else []
        if beyond <= 0:
            self.skipped.append(what)


@contextmanager
def opened(path: str | Path) -> Iterator[mmap.mmap]:
    """Map an MCAP file into memory.

    Raises:
        Sim2RealError: When there is no such file, or it is not an MCAP file.
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
    """Return the error for a log that was cut off before its first data."""
    return Sim2RealError(
        f"the log {path} was cut before the end of its session metadata: it holds no data",
        hint="the recording stopped while it was set up; record again",
    )


def records(data: mmap.mmap, damage: Damage) -> Iterator[Record]:
    """Yield the records of the data section without reading their content.

    Each record has its length, which leads to the next one. If a length is damaged, reading resumes at the next bytes
    that look like a chunk or the session's end.

    Args:
        damage: Damage that is found is added here.

    Raises:
        Sim2RealError: When records overlap.
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
        # A damaged length may have led past good chunks: search from the end of the last record known to be whole.
        resume = _next_landmark(data, trusted)
        if resume is None:
            break
        damage.skip(f"{resume - trusted} bytes at {trusted}")
        position, trusted = resume, resume + 1
    damage.cut = True


def chunk_times(data: mmap.mmap, record: Record) -> tuple[int, int]:
    """Return the first and the last log time in a chunk [ns]."""
    first, last = _CHUNK_TIMES.unpack_from(data, record.start)
    return first, last


def chunk_content(data: mmap.mmap, record: Record, damage: Damage) -> bytes:
    """Return the content of a chunk, decompressed and checked; empty if it is damaged.

    Args:
        damage: Damage that is found is added here.
    """
    try:
        return _decompressed(Chunk.read(stream_of(data, record)))
    except Exception as error:  # decompressors have their own exceptions
        damage.skip(f"a chunk of {record.end - record.start} bytes at {record.start} ({error})")
        return b""


def chunk_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the records in a chunk's content, without reading their content.

    These are the fields of ``Record``, but plain tuples are faster, and there is one for each message.

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


def parsed(kind: type[Any], data: mmap.mmap | bytes, record: Record, damage: Damage) -> Any | None:
    """Return a record parsed by a class of ``mcap.records``; None if it is damaged.

    Args:
        data: The file, or a chunk's content.
        damage: Damage that is found is added here.
    """
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
    # Lengths of chunks and message indices, most of a file, can be checked; of the others the opcode is checked.
    if opcode == _MESSAGE_INDEX:
        plausible = length >= 6 and length == 6 + _INDEX_BYTES.unpack_from(data, start)[0]
    elif opcode == _CHUNK:
        plausible = _is_chunk(data, start, length)
    elif opcode > _DATA_END:
        # A private record (from 0x80 on) or one of a later format, unless it is a chunk with a damaged opcode.
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
    """Return a chunk's content; a wrong size or checksum is an error, found without decompressing more than claimed."""
    size = chunk.uncompressed_size
    most = _TIGHTEST * len(chunk.data) + _SMALL_BYTES
    if size > (max(most, _TIGHTEST_ZSTD_BYTES) if chunk.compression == "zstd" else most):
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
    if len(content) != size:
        raise ValueError(f"it holds other than the {size} bytes that it claims")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ValueError("its checksum differs")
    return content


@lru_cache(maxsize=16)
def _zstd(_thread: int) -> Any:
    """Return a thread's decompressor; to make one takes longer than to decompress a small chunk."""
    import zstandard

    return zstandard.ZstdDecompressor()


def _blocks(stream: Any) -> Iterator[bytes]:
    """Yield the content of a stream in blocks, so that memory is taken only for what is there."""
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
