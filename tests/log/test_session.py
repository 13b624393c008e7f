"""How old the messages were that steps used, as a log tells it; the status of a log that nobody closed."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from sim2real.graph.episode import Episode, MemoryRecorder, MessageRecord, StepRecord
from sim2real.log.reader import read_log
from sim2real.log.session import input_ages

STEPS = {"sensor": [0, 10, 20, 30], "agent": [2, 12, 22, 32, 42]}
READ = [(0, 0), (1, 2), (2, 2), (3, -1)]
"""Messages of the sensor and the agent's steps that used them: the second has nothing new, the third takes two."""


@pytest.fixture
def episode():
    recorder = MemoryRecorder()
    for node, starts in STEPS.items():
        for k, start in enumerate(starts):
            recorder.step(StepRecord(node, k, start, start, start, -1, start + 1, 0), {"x": k})
    for seq_out, seq_in in READ:
        sent = STEPS["sensor"][seq_out] + 1
        recorder.message(MessageRecord("agent", "sensor", seq_out, seq_in, sent, sent))
        recorder.message(MessageRecord("agent", "other", seq_out, seq_in + 1 if seq_in >= 0 else -1, sent, sent))
    return recorder.episode()


def test_a_step_is_as_old_as_the_newest_message_that_it_used(episode):
    ages = input_ages(episode, "agent")
    np.testing.assert_allclose(1e6 * ages["sensor"], [1, 11, 1, 11, 21])
    np.testing.assert_allclose(1e6 * ages["other"], [np.nan, 11, 21, 11, 21])
    assert input_ages(episode, "sensor") == {}


def test_a_part_of_a_log_begins_with_what_it_holds(episode):
    steps = type(episode.steps["agent"])(*(column[2:] for column in vars(episode.steps["agent"]).values()))
    log = {"first_seq": {"agent": 2}, "missing_steps": {"agent": 0}}
    part = Episode({"agent": steps}, episode.messages, {}, {"log": log})
    np.testing.assert_allclose(1e6 * input_ages(part, "agent")["sensor"], [1, 11, 21])
    holes = Episode({"agent": steps}, episode.messages, {}, {"log": {**log, "missing_steps": {"agent": 1}}})
    assert input_ages(holes, "agent") == {}, "which step used what is not known"


def test_a_log_that_is_open_when_a_command_ends_is_aborted(tmp_path):
    """A command that failed ends its process without the interpreter's shutdown."""
    path = tmp_path / "session.mcap"
    program = textwrap.dedent("""
        import sys
        from sim2real.cli import _leave
        from sim2real.log import McapRecorder
        log = McapRecorder(sys.argv[1], {}, {}, {"a": {"x": 0.0}}, [])
        log.start(10**18, 0)
        _leave(3)
    """)
    assert subprocess.run([sys.executable, "-c", program, str(path)], check=False).returncode == 3
    assert read_log(path).metadata["log"]["session_end"]["status"] == "aborted"
