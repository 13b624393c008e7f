from __future__ import annotations

import warnings

import fake_sessions
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.graph.episode import MemoryRecorder, StepRecord
from sim2real.log import McapRecorder, TruncatedLogWarning, read_log, read_session, summary


def assert_same(a, b):
    assert a.steps.keys() == b.steps.keys()
    assert a.messages.keys() == b.messages.keys()
    for left, right in ((a.steps, b.steps), (a.messages, b.messages)):
        for key, record in left.items():
            for column in record.__dataclass_fields__:
                np.testing.assert_array_equal(getattr(record, column), getattr(right[key], column), str((key, column)))
                assert getattr(record, column).dtype == np.int64
    for node, fields in a.outputs.items():
        assert fields.keys() == b.outputs[node].keys()
        for name, values in fields.items():
            np.testing.assert_array_equal(values, b.outputs[node][name])
            assert values.dtype == b.outputs[node][name].dtype
            assert values.shape == b.outputs[node][name].shape


def test_a_log_reads_back_as_what_was_recorded(tmp_path):
    path = tmp_path / "session.mcap"
    memory = MemoryRecorder()
    log = McapRecorder(path, *fake_sessions.arguments())
    for recorder in (memory, log):
        recorder.start(fake_sessions.EPOCH_NS, 123)
    fake_sessions.feed(range(400), memory, log)
    log.close("finished", 0, {"overruns": {"agent": np.int64(3)}})
    log.close()

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode = read_log(path)
    expected = memory.episode()
    last = {key: m.seq_in == 400 for key, m in expected.messages.items()}
    assert not any(mask.any() for mask in last.values())
    assert_same(episode, expected)
    assert episode.complete
    assert episode.duration_s == expected.duration_s
    assert episode.metadata["config"] == {"rate": 200.0, "gains": [1.0, 2.0]}
    facts = episode.metadata["log"]
    assert facts["session_end"]["status"] == "finished"
    assert facts["session_end"]["overruns"] == {"agent": 3}
    assert facts["epoch_ns"] == fake_sessions.EPOCH_NS
    assert facts["first_seq"] == dict.fromkeys(fake_sessions.outputs(), 0)


def test_jax_arrays_and_reused_buffers_are_recorded_as_they_were(tmp_path):
    buffer = np.zeros(3)
    with McapRecorder(tmp_path / "x.mcap", {}, {}, {"a": {"x": jnp.zeros((2, 2)), "y": buffer}}, []) as log:
        log.start(10**18, 0)
        for k in range(20):
            buffer[:] = k
            log.step(StepRecord("a", k, k, k, k, -1, k, 0), {"x": jnp.full((2, 2), k, jnp.float32), "y": buffer})
    out = read_log(tmp_path / "x.mcap").outputs["a"]
    np.testing.assert_array_equal(out["x"], np.arange(20)[:, None, None] * np.ones((2, 2)))
    np.testing.assert_array_equal(out["y"], np.arange(20)[:, None] * np.ones(3))


def test_metadata_reads_without_the_data(session_log):
    assert read_session(session_log)["pipeline"] == "fake"
    facts = summary(session_log)
    assert facts["attachments"] == {name: len(content) for name, content in fake_sessions.ATTACHMENTS.items()}
    assert facts["topics"]["/sensor/step"] == 800
    assert facts["topics"]["/joint_states"] == 800
    assert facts["topics"]["/agent/inputs/sensor_reading"] == 799
    assert facts["complete"]
    assert facts["duration_s"] == pytest.approx(3.9955, abs=1e-3)


def test_a_range_of_time(session_log):
    whole = read_log(session_log)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        part = read_log(session_log, start_s=1.0, end_s=2.0)
    first = part.metadata["log"]["first_seq"]["world"]
    assert (first, len(part.steps["world"])) == (200, 200)
    np.testing.assert_array_equal(part.steps["world"].start, whole.steps["world"].start[200:400])
    np.testing.assert_array_equal(part.outputs["world"]["pose"], whole.outputs["world"]["pose"][200:400])
    messages = part.messages["agent", "sensorReading"]
    assert messages.seq_out.tolist() == list(range(200, 400))
    assert messages.seq_in.tolist() == [*range(201, 400), -1]
    assert len(read_log(session_log, start_s=100.0).steps["world"]) == 0
    with pytest.raises(UsageError, match="after its end"):
        read_log(session_log, start_s=2.0, end_s=1.0)


def test_an_exception_becomes_the_status(tmp_path):
    path = tmp_path / "x.mcap"

    def session():
        with McapRecorder(path, {}, {}, {"a": {"x": 0.0}}, []) as log:
            log.start(10**18, 0)
            log.step(StepRecord("a", 0, 0, 0, 0, -1, 1, 0), {"x": 1.0})
            raise SafetyStop("knee too hot")

    with pytest.raises(SafetyStop):
        session()
    end = read_log(path).metadata["log"]["session_end"]
    assert (end["status"], end["exit_code"]) == ("SafetyStop: knee too hot", 3)


def test_misuse_is_an_error(tmp_path):
    path = tmp_path / "x.mcap"
    with McapRecorder(path, {}, {}, {"a": {"x": 0.0}}, []) as log:
        log.start(10**18, 0)
        with pytest.raises(Sim2RealError, match="has an episode already"):
            log.start(10**18, 0)
        with pytest.raises(Sim2RealError, match="node 'a' has the fields y, expected x"):
            log.step(StepRecord("a", 0, 0, 0, 0, -1, 1, 0), {"y": 1.0})
    with pytest.raises(Sim2RealError, match="is closed"):
        log.step(StepRecord("a", 1, 0, 0, 0, -1, 1, 0), {"x": 1.0})
    with pytest.raises(Sim2RealError, match="exists already"):
        McapRecorder(path, {}, {}, {}, [])
    with pytest.raises(Sim2RealError, match=r"cannot be written as JSON.*object"):
        McapRecorder(tmp_path / "y.mcap", {"x": object()}, {}, {}, [])
    with pytest.raises(Sim2RealError, match="cannot be created"):
        McapRecorder(tmp_path / "no" / "y.mcap", {}, {}, {}, [])
    log = McapRecorder(tmp_path / "z.mcap", {}, {}, {"a": {"x": 0.0}}, [])
    log.step(StepRecord("a", 0, 0, 0, 0, -1, 1, 0), {"x": 1.0})
    with pytest.raises(Sim2RealError, match="call start"):
        log.close()


@pytest.mark.parametrize(
    ("record", "output", "message"),
    [
        (StepRecord("b", 0, 0, 0, 0, -1, 1, 0), {}, "node 'b' is not in this log. Available: a"),
        (StepRecord("a", 7, 0, 0, 0, -1, 1, 0), {"x": np.zeros(4)}, "step 7 of node 'a'.*'x' has shape"),
    ],
)
def test_what_goes_wrong_in_the_writer_reaches_the_caller(tmp_path, record, output, message):
    log = McapRecorder(tmp_path / "x.mcap", {}, {}, {"a": {"x": np.zeros(3)}}, [])
    log.start(10**18, 0)
    log.step(record, output)
    log._thread.join(10)
    with pytest.raises(Sim2RealError, match=message):
        log.step(StepRecord("a", 1, 0, 0, 0, -1, 1, 0), {"x": np.zeros(3)})
    with pytest.raises(Sim2RealError, match=message):
        log.close()
    with pytest.warns(TruncatedLogWarning, match="no end"):
        assert not read_log(tmp_path / "x.mcap").complete
