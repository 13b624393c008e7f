from __future__ import annotations

from pathlib import Path

import fake_sessions
import pytest

from sim2real.log.session_file import SessionFile


class Flushed:
    """Writes a session file directly, flushed every 0.2 s of the fake robot's time, however fast it is fed."""

    def __init__(self, file: SessionFile):
        self.file = file
        self.next_flush = 200_000

    def step(self, record, output):
        from sim2real.log.writer import _snapshot

        names = dict.fromkeys(fake_sessions.outputs()["world"]) if record.node == "world" else {}
        self.file.step(record, _snapshot(record.node, output, names))
        if record.end >= self.next_flush:
            self.file.flush()
            self.next_flush += 200_000

    def message(self, record):
        self.file.message(record)


@pytest.fixture(scope="session")
def session_log(tmp_path_factory) -> Path:
    """A finished log of 4 s."""
    path = tmp_path_factory.mktemp("log") / "session.mcap"
    file = SessionFile(path, *fake_sessions.arguments())
    file.start(fake_sessions.EPOCH_NS, 0)
    fake_sessions.feed(range(800), Flushed(file))
    file.flush()
    file.finish({"status": "finished", "exit_code": 0})
    return path
