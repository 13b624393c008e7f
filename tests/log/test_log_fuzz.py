"""Files that were made to harm: an error in words or a log with a warning, soon, and without filling the memory."""

import io
import struct
import tracemalloc
import warnings

import fake_sessions
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from sim2real.errors import Sim2RealError
from sim2real.log import TruncatedLogWarning, read_log, summary
from sim2real.log.writer import SessionFile

WEIRD = [
    "", "O", "|V16", "<f8", "-1", "9" * 40, "\x1b[2J", "null", "[]", "{}", "[" * 5000, '[{"name": "x"}]', "٣٤",
    '[{"name": "x", "original": "x", "dtype": "<f8", "shape": [-1]}]',
    '[{"name": "x", "original": "x", "dtype": "<f8", "shape": [9000000000, 9000000000]}]',
    '[{"name": "x", "original": "x", "dtype": "O", "shape": []}]',
    '[{"name": 3, "original": 4, "dtype": 5, "shape": 6}]',
]  # fmt: skip


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """A whole log of 0.2 s, nowhere packed and nowhere guarded by a checksum: what is bent in it gets through."""
    path = tmp_path_factory.mktemp("fuzz") / "session.mcap"
    file = SessionFile(path, *fake_sessions.arguments())
    file.start(fake_sessions.EPOCH_NS, 0)
    fake_sessions.feed(range(40), fake_sessions.Flushed(file))
    file.finish({"status": "finished", "exit_code": 0})
    return rewritten(path.read_bytes())


def rewritten(content, change=lambda channel: None):
    """Write a log anew, without compression and checksums, its channels changed."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=4096, compression=CompressionType.NONE, enable_crcs=False)
    writer.start("ros2", "sim2real")
    schemas, channels = {}, {}
    for record in StreamReader(io.BytesIO(content)).records:
        match type(record).__name__:
            case "Metadata":
                writer.add_metadata(record.name, record.metadata)
            case "Schema":
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case "Channel" if record.id not in channels:
                change(record)
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            case "Message":
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
    writer.finish()
    return out.getvalue()


@pytest.fixture
def survive(tmp_path):
    """Read a file in every way; it may be refused, in words."""
    path = tmp_path / "made.mcap"

    def ways():
        yield lambda: read_log(path)
        yield lambda: read_log(path, 0.05, 0.1)
        yield lambda: summary(path)

    def call(content):
        path.write_bytes(content)
        said = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TruncatedLogWarning)
            for way in ways():
                try:
                    way()
                except Sim2RealError as error:
                    said.append(str(error))
        return said

    return call


@pytest.fixture(params=[range(25), pytest.param(range(25, 1000), marks=pytest.mark.night)], ids=["gate", "night"])
def for_a_while(request):
    """Repeat an attempt with one seed after the other."""

    def repeat(attempt):
        for seed in request.param:
            attempt(np.random.default_rng(seed))

    return repeat


def test_bytes_bent_at_random(content, survive, for_a_while):
    def attempt(rng):
        bent = bytearray(content)
        for _ in range(rng.integers(1, 8)):
            place, size = int(rng.integers(len(bent))), int(rng.integers(1, 64))
            match rng.integers(4):
                case 0:
                    bent[place] ^= 1 << int(rng.integers(8))
                case 1:
                    bent[place : place + size] = rng.bytes(size)
                case 2:
                    del bent[place : place + size]
                case 3:
                    source = int(rng.integers(len(bent)))
                    bent[place:place] = bent[source : source + size]
        survive(bytes(bent))

    for_a_while(attempt)


def test_channels_that_say_weird_things(content, survive, for_a_while):
    def attempt(rng):
        def change(channel):
            if rng.random() < 0.3:
                key = str(rng.choice([*channel.metadata, "role", "node", "input", "fields"]))
                if rng.random() < 0.2:
                    channel.metadata.pop(key, None)
                else:
                    channel.metadata[key] = WEIRD[rng.integers(len(WEIRD))]

        survive(rewritten(content, change))

    for_a_while(attempt)


def gigabyte(compression):
    """Return a gigabyte of zeros, packed; of LZ4's, which packs 255 to 1 at most, what is in the first 400 kB."""
    block, compressor = bytes(10_000_000), zstandard.ZstdCompressor().compressobj()
    if compression == "lz4":
        return lz4.frame.compress(bytes(110_000_000))[:400_000]
    return b"".join(compressor.compress(block) for _ in range(100)) + compressor.flush()


@pytest.mark.parametrize(("compression", "claim"), [("zstd", 10**9), ("zstd", 1000), ("lz4", 1000)])
def test_chunks_that_unpack_to_more_than_memory_holds(content, survive, compression, claim):
    packed = gigabyte(compression)
    chunk = Chunk(
        compression=compression,
        data=packed,
        message_start_time=0,
        message_end_time=2**63,
        uncompressed_crc=0,
        uncompressed_size=claim,
    )
    builder = RecordBuilder()
    chunk.write(builder)
    bomb = builder.end()
    end = content.index(struct.pack("<BQI", 15, 4, 0), len(MCAP0_MAGIC))
    tracemalloc.start()
    survive(content[:end] + bomb + content[end:])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30e6


def test_records_that_overlap(survive):
    # Each of these is where reading resumes, and leads through all the others to the same broken place.
    name = b"session_end"
    landmark = struct.pack("<BQI", 12, 4 + len(name) + 4, len(name)) + name + struct.pack("<I", 0)
    assert any("overlap" in said for said in survive(MCAP0_MAGIC + landmark * 100 + b"\0" * 9))
