"""Files with bytes bent at random: an error in words or a log with a warning."""

import io
import warnings

import fake_sessions
import numpy as np
import pytest
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

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
