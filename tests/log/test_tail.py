"""The tail of a log: whatever the size of its growth, the parts make up the log."""

import fake_sessions
import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.log import McapRecorder, read_log
from sim2real.log.reader import LogTail


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "session.mcap"
    recorder = McapRecorder(path, *fake_sessions.arguments())
    recorder.start(fake_sessions.EPOCH_NS, 123)
    fake_sessions.feed(range(3000), recorder)
    recorder.close("finished", 0, {})
    return path


@pytest.mark.parametrize("seed", range(5))
def test_a_log_that_grows_by_any_bytes_is_read_once_and_whole(log, tmp_path, seed):
    content, rng = log.read_bytes(), np.random.default_rng(seed)
    growing = tmp_path / "growing.mcap"
    growing.touch()
    tail, parts, at = LogTail(growing), [], 0
    with open(growing, "ab", buffering=0) as stream:
        while at < len(content):
            size = int(rng.choice([1, 100, 5_000, 70_000]))
            stream.write(content[at : at + size])
            at += size
            assert not tail.ended or at > 0.9 * len(content)
            if (part := tail.read()) is not None:
                parts.append(part)
    whole = read_log(log)
    assert tail.ended
    assert tail.epoch_ns == fake_sessions.EPOCH_NS
    assert len(parts) > 2
    assert tail.read() is None
    for node, steps in whole.steps.items():
        for column in steps.__dataclass_fields__:
            np.testing.assert_array_equal(
                np.concatenate([getattr(p.steps[node], column) for p in parts]), getattr(steps, column)
            )
        for name, values in whole.outputs[node].items():
            np.testing.assert_array_equal(np.concatenate([p.outputs[node][name] for p in parts]), values)
    assert parts[0].metadata["pipeline"] == "fake"
    assert parts[0].units == whole.units


def test_a_damaged_chunk_is_left_out_and_another_file_is_refused(log, tmp_path):
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    damaged = LogTail(path).read()
    assert damaged is not None
    assert 0 < len(damaged.steps["agent"]) <= 3000
    path.write_bytes(b"no log at all, but longer than its magic bytes")
    with pytest.raises(Sim2RealError, match="no MCAP file"):
        LogTail(path).read()
