"""A writer that falls behind: nothing is lost, memory has a bound, and a stuck disk is told from a slow writer."""

import threading
import time

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import StepRecord
from sim2real.log import backlog, writer
from sim2real.log.backlog import RECORD_BYTES, Backlog
from sim2real.log.reader import read_log
from sim2real.log.writer import McapRecorder

OUTPUT = {"x": np.zeros(6)}


def slow(recorder, seconds, gate=None):
    """Let each step take some time to write, or wait for a gate."""
    step = recorder._file.step

    def wait(record, leaves):
        time.sleep(seconds)
        if gate is not None:
            gate.wait(20)
        step(record, leaves)

    recorder._file.step = wait
    return recorder


def feed(recorder, count, first=0):
    for k in range(first, first + count):
        recorder.step(StepRecord("n", k, 1000 * k, 1000 * k, 1000 * k, -1, 1000 * k + 1, 0), {"x": np.full(6, k)})


@pytest.fixture
def recorder(tmp_path):
    made = McapRecorder(tmp_path / "session.mcap", {"pipeline": "x"}, {}, {"n": OUTPUT}, [])
    made.start(time.time_ns(), time.monotonic_ns())
    return made


def test_close_waits_for_a_slow_writer_as_long_as_it_comes_on(recorder, monkeypatch):
    """The whole queue takes ten times as long as a disk may be silent."""
    monkeypatch.setattr(backlog, "STUCK_S", 0.2)
    monkeypatch.setattr(writer, "CHECK_PERIOD_S", 0.01)
    monkeypatch.setattr(writer, "REPORT_PERIOD_S", 0.5)
    feed(slow(recorder, 0.01), 200)
    said = []
    recorder.close(report=said.append)
    assert len(read_log(recorder.path).steps["n"]) == 200
    assert said
    assert all(text.startswith("writing the log: the writer of the log is ") for text in said)
    assert said[0].endswith("wait, the disk takes data")


def test_a_stuck_disk_ends_the_wait_and_is_blamed(recorder, monkeypatch):
    monkeypatch.setattr(backlog, "STUCK_S", 0.3)
    monkeypatch.setattr(writer, "CHECK_PERIOD_S", 0.01)
    gate = threading.Event()
    feed(slow(recorder, 0.0, gate), 50)
    with pytest.raises(Sim2RealError, match=r"the disk took no data for 0 s: .* has no end, 5\d records are lost"):
        recorder.close()
    gate.set()
    recorder._thread.join(10)


def test_the_backlog_tells_a_slow_writer_from_a_stuck_disk_and_from_a_pause(recorder):
    assert recorder.backlog().behind_s == 0.0
    gate = threading.Event()
    feed(slow(recorder, 0.0, gate), 100)
    time.sleep(0.3)
    left = recorder.backlog()
    assert (left.records, left.bytes) == (100, 100 * (RECORD_BYTES + OUTPUT["x"].nbytes))
    assert left.idle_s >= 0.25
    gate.set()
    while recorder.backlog().records:
        time.sleep(0.01)
    time.sleep(0.3)  # the robot pauses: nothing is late
    feed(recorder, 1, 100)
    assert recorder.backlog().behind_s < 0.25
    recorder.close()
    assert str(Backlog(5, 10**6, 4.0, 4.0)).startswith("the disk has taken no data for 4 s; 5 records (1 MB) wait")
    assert str(Backlog(5, 10**6, 4.0, 0.1)).startswith("the writer of the log is 4.0 s behind; 5 records (1 MB) wait")
    assert [Backlog(5, 0, 1.5, 0.0).late, Backlog(5, 0, 0.5, 0.0).late, Backlog(0, 0, 1.5, 0.0).late] == [
        True, False, False,
    ]  # fmt: skip


def test_memory_has_a_bound_beyond_which_the_recording_ends_and_nothing_is_lost(recorder, monkeypatch):
    monkeypatch.setattr(recorder, "_max_bytes", 200_000)
    monkeypatch.setattr(writer, "RECORDS_PER_CHECK", 8)
    gate = threading.Event()
    slow(recorder, 0.0, gate)
    said = r"more than 0 MB .* would wait in memory[\s\S]*hint: the log holds"
    with pytest.raises(Sim2RealError, match=said) as e:
        feed(recorder, 10_000)
    taken = recorder._queued["n"]
    assert 300 < taken < 500, "200 kB of records of 548 bytes"
    with pytest.raises(Sim2RealError) as again:
        feed(recorder, 1, taken)
    assert again.value is e.value
    gate.set()
    recorder.close("overflow", 1)
    episode = read_log(recorder.path)
    assert len(episode.steps["n"]) >= taken
    assert episode.metadata["log"]["session_end"]["longest_behind_s"] >= 0.0
