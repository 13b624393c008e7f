from __future__ import annotations

from pathlib import Path

import fake_sessions
import pytest

from sim2real.log.writer import SessionFile


@pytest.fixture(scope="session")
def session_log(tmp_path_factory) -> Path:
    """A finished log of 4 s."""
    path = tmp_path_factory.mktemp("log") / "session.mcap"
    file = SessionFile(path, *fake_sessions.arguments())
    file.start(fake_sessions.EPOCH_NS, 0)
    fake_sessions.feed(range(800), fake_sessions.Flushed(file))
    file.flush()
    file.finish({"status": "finished", "exit_code": 0})
    return path
