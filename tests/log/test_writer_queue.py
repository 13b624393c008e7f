"""The writer's queue, without a clock: the file is held by a lock, so each test knows what waits."""

import threading

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import StepRecord
from sim2real.log import writer
from sim2real.log.reader import read_log
from sim2real.log.writer import McapRecorder

OUTPUT = {"x": np.zeros(6)}


@pytest.fixture
def held(tmp_path):
    """A recorder whose file takes no step until its gate is set."""
    recorder = McapRecorder(tmp_path / "session.mcap", {"pipeline": "x"}, {}, {"n": OUTPUT}, [])
    recorder.start(10**18, 0)
    gate, step, entered = threading.Event(), recorder._file.step, threading.Event()

    def wait(record, leaves):
        entered.set()
        assert gate.wait(60)
        step(record, leaves)

    recorder._file.step = wait
    yield recorder, gate, entered
    gate.set()
    recorder._thread.join(60)


def feed(recorder, count, first=0):
    for k in range(first, first + count):
        recorder.step(StepRecord("n", k, 1000 * k, 1000 * k, 1000 * k, -1, 1000 * k + 1, 0), {"x": np.full(6, k)})


def test_close_waits_for_a_slow_disk_and_reports_it(held, monkeypatch):
    recorder, gate, entered = held
    monkeypatch.setattr(writer, "WAIT_S", 0.001)
    monkeypatch.setattr(writer, "REPORT_WAITS", 1)
    feed(recorder, 200)
    assert entered.wait(60)
    assert recorder.waiting > 0
    reports = []

    def report(text):
        reports.append(text)
        gate.set()

    recorder.close(report=report)
    assert "199 records" in reports[0] or "200 records" in reports[0]
    assert len(read_log(recorder.path).steps["n"]) == 200
    assert recorder.waiting == 0


def test_a_disk_that_takes_nothing_ends_the_wait(held, monkeypatch):
    recorder, _, _ = held
    monkeypatch.setattr(writer, "WAIT_S", 0.001)
    monkeypatch.setattr(writer, "STUCK_S", 0.02)
    feed(recorder, 50)
    with pytest.raises(Sim2RealError, match="took no data"):
        recorder.close()


def test_memory_has_a_limit_and_what_was_queued_is_written(held, monkeypatch):
    recorder, gate, _ = held
    assert recorder._most_waiting * 548 < writer.MAX_QUEUE_BYTES, "records of 548 bytes"
    monkeypatch.setattr(recorder, "_most_waiting", 360)
    with pytest.raises(Sim2RealError, match="wait in memory") as error:
        feed(recorder, 10_000)
    with pytest.raises(Sim2RealError) as again:
        feed(recorder, 1, 10_000)
    assert again.value is error.value
    gate.set()
    recorder.close("overflow", 1)
    episode = read_log(recorder.path)
    assert 360 <= len(episode.steps["n"]) <= 363
    assert episode.metadata["log"]["session_end"]["status"] == "overflow"
