"""What the command line says of an error that carries notes: all of it, no traceback, the hint last."""

import sys
from types import ModuleType

import pytest

from sim2real import cli
from sim2real.errors import HardwareLost
from sim2real.runtime.failure import NodeFailed, named


@pytest.fixture
def say(monkeypatch, capsys, tmp_path):
    """Let the record stage fail with an error and return what is said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def call(error, code):
        module = ModuleType("sim2real.stages.session.record")

        def run(*_):
            raise error

        module.run = run
        monkeypatch.setitem(sys.modules, "sim2real.stages.session.record", module)
        assert cli.main(["record", "pendulum"]) == code
        said = capsys.readouterr()
        assert not said.out
        return said.err

    return call


def test_notes_stand_between_message_and_hint(say):
    error = named(HardwareLost("no answer", hint="check the cable"), "sensor", "step 12")
    error.add_note("then: OSError:\n disk full")
    expected = "error: no answer\n  node 'sensor', step 12\n  then: OSError: disk full\n\nhint: check the cable\n"
    assert say(error, 4) == expected


def test_wrapped_errors_name_their_node(say):
    error = named(KeyError("x"), "agent", "step 3")
    assert isinstance(error, NodeFailed)
    assert say(error, 1) == "error: node 'agent' failed in its step 3: KeyError: 'x'\n"


def test_signals_are_named(say):
    assert say(SystemExit(143), 143) == "ended by SIGTERM\n"
