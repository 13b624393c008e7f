from __future__ import annotations

import errno
import os
import resource
import signal
import struct
import subprocess
import sys
import textwrap
import time
import warnings
from pathlib import Path

import fake_sessions
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import StepRecord
from sim2real.log import McapRecorder, TruncatedLogWarning, read_log, read_session, summary
from sim2real.log.writer import SessionFile


def quietly(call, *arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TruncatedLogWarning)
        return call(*arguments)


def read_quietly(path):
    return quietly(read_log, path)


def chunks(path):
    """(offset, length, last log time) of every chunk, by an independent reader."""
    with open(path, "rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [(c.chunk_start_offset, c.chunk_length, c.message_end_time) for c in summary.chunk_indexes]


def data_begins(path):
    """Where the session's metadata and attachments end."""
    with open(path, "rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return max(a.offset + a.length for a in [*summary.metadata_indexes[:1], *summary.attachment_indexes])


def assert_prefix(part, whole):
    for node, steps in part.steps.items():
        n = len(steps)
        if not n:
            continue
        np.testing.assert_array_equal(steps.end, whole.steps[node].end[:n])
        for name, values in part.outputs[node].items():
            np.testing.assert_array_equal(values, whole.outputs[node][name][:n])
    for key, messages in part.messages.items():
        if len(messages):
            np.testing.assert_array_equal(messages.received, whole.messages[key].received[: len(messages)])


def test_a_log_cut_anywhere_loses_at_most_a_quarter_of_a_second(session_log, tmp_path):
    whole, index, content = read_log(session_log), chunks(session_log), session_log.read_bytes()
    cut = tmp_path / "cut.mcap"
    rng = np.random.default_rng(0)
    first, last = data_begins(session_log), index[-1][0] + index[-1][1]
    for position in rng.integers(first, last, 60):
        cut.write_bytes(content[:position])
        with pytest.warns(TruncatedLogWarning, match="no end"):
            part = read_log(cut)
        assert not part.complete
        assert part.metadata["pipeline"] == "fake"
        assert_prefix(part, whole)
        # What was in the file at the cut was recorded up to the end of the chunk in which the cut lies.
        recorded_s = min((t - fake_sessions.EPOCH_NS) / 1e9 for begin, size, t in index if begin + size > position)
        assert part.duration_s >= recorded_s - 0.25


def test_a_log_cut_before_the_end_of_its_metadata_is_an_error(session_log, tmp_path):
    content, cut = session_log.read_bytes(), tmp_path / "cut.mcap"
    session_ends = content.index(b"config.yaml") - 29  # where the first attachment's record begins
    for position in [0, 3, 8, 20, 60, session_ends // 2, session_ends - 1]:
        cut.write_bytes(content[:position])
        for read in (read_log, read_session, summary):
            with pytest.raises(Sim2RealError, match=r"(?s)cut before the end of its session metadata.*hint: "):
                read(cut)


@pytest.mark.parametrize("whole_file", [True, False])
def test_a_flipped_bit_loses_at_most_one_chunk(session_log, tmp_path, whole_file):
    whole, content = read_log(session_log), bytearray(session_log.read_bytes())
    index = chunks(session_log)
    if not whole_file:
        del content[index[-1][0] + index[-1][1] :]
    bent = tmp_path / "bent.mcap"
    rng = np.random.default_rng(2)
    # Anywhere, and more often in the few bytes that frame the chunks, where a flip hurts most.
    places = [int(p) for p in rng.integers(data_begins(session_log), len(content), 25)]
    places += [begin + int(k) for begin, _, _ in index[::4] for k in rng.integers(0, 60, 3)]
    steps_per_chunk = 0.25 * fake_sessions.RATE_HZ
    for place in places:
        content[place] ^= 1 << int(rng.integers(8))
        bent.write_bytes(content)
        content[place] = session_log.read_bytes()[place]
        part = read_quietly(bent)
        for node, steps in whole.steps.items():
            kept = np.isin(steps.end, part.steps[node].end)
            lost = np.flatnonzero(~kept)
            assert len(lost) <= steps_per_chunk, place
            assert len(lost) == 0 or lost[-1] - lost[0] < steps_per_chunk
            assert len(part.steps[node]) == kept.sum()
            for name, values in whole.outputs[node].items():
                np.testing.assert_array_equal(part.outputs[node][name], values[kept])


@pytest.fixture(scope="module")
def short_log(tmp_path_factory):
    """A finished log of half a second, and where its first chunk begins."""
    path = tmp_path_factory.mktemp("short") / "session.mcap"
    file = SessionFile(path, *fake_sessions.arguments())
    file.start(fake_sessions.EPOCH_NS, 0)
    fake_sessions.feed(range(100), fake_sessions.Flushed(file))
    file.finish({"status": "finished", "exit_code": 0})
    return path, chunks(path)[0][0]


def test_what_is_bent_before_the_first_chunk_costs_no_data(short_log, tmp_path):
    path, first = short_log
    whole, content = read_log(path), bytearray(path.read_bytes())
    bent = tmp_path / "bent.mcap"
    rng = np.random.default_rng(3)
    for place in rng.integers(8, first, 60).tolist():
        bit = 1 << int(rng.integers(8))
        content[place] ^= bit
        bent.write_bytes(content)
        content[place] ^= bit
        part = read_quietly(bent)
        assert part.steps.keys() == whole.steps.keys(), place
        assert all(len(part.steps[n]) == len(s) for n, s in whole.steps.items()), place
        assert_prefix(part, whole)
        tail = quietly(read_log, bent, 0.4)
        assert len(tail.steps["world"]) == len(read_log(path, 0.4).steps["world"]), place


@pytest.mark.parametrize("opcode", [0x10, 0x80, 0xFF])
def test_records_that_others_may_use_are_passed_over(session_log, tmp_path, opcode):
    content, begin = session_log.read_bytes(), chunks(session_log)[3][0]
    private = tmp_path / "private.mcap"
    private.write_bytes(content[:begin] + struct.pack("<BQ", opcode, 4) + b"mine" + content[begin:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_log(private).steps["world"]) == 800


def test_a_chunk_whose_opcode_became_private_is_missed(session_log, tmp_path):
    content = bytearray(session_log.read_bytes())
    content[chunks(session_log)[3][0]] |= 0x80
    bent = tmp_path / "bent.mcap"
    bent.write_bytes(content)
    with pytest.warns(TruncatedLogWarning, match=r"unreadable: \d+ bytes at"):
        read_log(bent)


def test_a_lost_chunk_is_reported(session_log, tmp_path):
    content = bytearray(session_log.read_bytes())
    begin, size, _ = chunks(session_log)[3]
    content[begin + size // 2] ^= 255
    bent = tmp_path / "bent.mcap"
    bent.write_bytes(content)
    with pytest.warns(TruncatedLogWarning, match=r"unreadable: a chunk of .* steps are missing: \d+ of node 'world'"):
        episode = read_log(bent)
    assert episode.complete
    assert episode.metadata["log"]["missing_steps"]["world"] == 800 - len(episode.steps["world"]) > 0


def test_files_that_are_no_logs(tmp_path, session_log):
    with pytest.raises(Sim2RealError, match=r"(?s)there is no log .*nothing.mcap.*hint: .*session.mcap"):
        read_log(session_log.with_name("nothing.mcap"))
    text = tmp_path / "notes.txt"
    text.write_text("The arm moved.")
    with pytest.raises(Sim2RealError, match="is no MCAP file"):
        read_log(text)
    foreign = tmp_path / "foreign.mcap"
    with open(foreign, "wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "somebody else")
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    for read in (read_log, read_session, summary):
        with pytest.raises(Sim2RealError, match="an MCAP file of 'somebody else', not a log of sim2real"):
            read(foreign)


@pytest.mark.process
def test_a_killed_process_leaves_all_but_the_last_quarter_of_a_second(tmp_path):
    path = tmp_path / "killed.mcap"
    program = textwrap.dedent("""
        import sys, time
        sys.path.insert(0, sys.argv[2])
        import fake_sessions
        from sim2real.log import McapRecorder
        log = McapRecorder(sys.argv[1], *fake_sessions.arguments())
        log.start(fake_sessions.EPOCH_NS, 0)
        begin = time.monotonic()
        for k in range(10_000):
            fake_sessions.feed(range(k, k + 1), log)
            print(k, flush=True)
            time.sleep(max(0.0, begin + (k + 1) / fake_sessions.RATE_HZ - time.monotonic()))
    """)
    command = [sys.executable, "-c", program, str(path), str(Path(__file__).parent)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= 330:
            os.kill(process.pid, signal.SIGKILL)
            break
    rest = process.stdout.read().split()
    last = int(rest[-1]) if rest else int(line)
    process.wait(10)
    with pytest.warns(TruncatedLogWarning, match="no end"):
        episode = read_log(path)
    recorded_s = (last + 1) / fake_sessions.RATE_HZ
    assert episode.duration_s >= recorded_s - 0.25
    expected = fake_sessions.outputs(len(episode.steps["world"]) - 1)["world"]["pose"]
    np.testing.assert_array_equal(episode.outputs["world"]["pose"][-1], expected)


def test_a_process_that_forgets_to_close_the_log_closes_it_at_its_end(tmp_path):
    path = tmp_path / "x.mcap"
    program = textwrap.dedent("""
        import sys
        from sim2real.graph.episode import StepRecord
        from sim2real.log import McapRecorder
        log = McapRecorder(sys.argv[1], {}, {}, {"a": {"x": 0.0}}, [])
        log.start(10**18, 0)
        log.step(StepRecord("a", 0, 0, 0, 0, -1, 1, 0), {"x": 1.0})
        raise RuntimeError("no torque")
    """)
    result = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True)
    assert "no torque" in result.stderr
    episode = read_log(path)
    assert episode.metadata["log"]["session_end"]["status"] == "aborted"
    assert len(episode.steps["a"]) == 1


def test_a_full_disk_reaches_the_caller(tmp_path, monkeypatch):
    path = tmp_path / "x.mcap"
    log = McapRecorder(path, {}, {}, {"a": {"x": 0.0}}, [])
    log.start(10**18, 0)

    def full() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(log._file, "flush", full)
    log.step(StepRecord("a", 0, 0, 0, 0, -1, 1, 0), {"x": 1.0})
    log._thread.join(10)
    with pytest.raises(Sim2RealError, match=r"(?s)failed: .*No space left.*hint: check the disk"):
        log.step(StepRecord("a", 1, 0, 0, 0, -1, 1, 0), {"x": 1.0})
    with pytest.raises(Sim2RealError, match="No space left"):
        log.close()
    log.close()


def test_a_disk_that_fills_up_leaves_the_log_readable_up_to_there(tmp_path):
    path = tmp_path / "x.mcap"
    values = np.random.default_rng(0).normal(size=100_000)
    log = McapRecorder(path, {"pipeline": "fake"}, {}, {"a": {"x": 0.0}}, [])
    log.start(10**18, 0)

    def feed(steps):
        for k in steps:
            log.step(StepRecord("a", k, k, k, k, -1, k + 1, 0), {"x": values[k]})

    feed(range(500))
    while len(read_quietly(path).steps.get("a", ())) < 500:  # until it is flushed
        time.sleep(0.05)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, before[1]))
    try:
        with pytest.raises(Sim2RealError, match=r"(?s)failed: .*hint: check the disk") as caught:
            feed(range(500, 100_000))
        with pytest.raises(Sim2RealError) as again:
            log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert again.value is caught.value, "one failure is told once"
    with pytest.warns(TruncatedLogWarning, match="no end"):
        episode = read_log(path)
    np.testing.assert_array_equal(episode.outputs["a"]["x"], values[: len(episode.steps["a"])])
    assert len(episode.steps["a"]) >= 500


def test_a_disk_that_is_full_from_the_start(tmp_path, monkeypatch):
    def full(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(SessionFile, "flush", full)
    with pytest.raises(Sim2RealError, match=r"(?s)cannot be written: No space left.*hint: "):
        McapRecorder(tmp_path / "x.mcap", {}, {}, {"a": {"x": 0.0}}, [])
