"""CI fails where a test is skipped for a reason that is not in the list."""

from types import SimpleNamespace

import pytest
import skips

OF_CI = "no composition document in /x (set SIM2REAL_SEEDS)"
MISSING = 'Warp is not installed: pip install "sim2real[warp]"'


def skipped(why):
    return pytest.TestReport("t.py::t", ("t.py", 1, "t"), {}, "skipped", ("t.py", 1, f"Skipped: {why}"), "setup")


@pytest.mark.parametrize(
    ("why", "accepted"),
    [
        (OF_CI, True),
        ("/x/a.npz is not there; SIM2REAL_DATA names the folder of the public recordings", True),
        (MISSING, False),
        ("the oracle: pip install dm-control==1.0.50", False),
        ("could not import 'onnxruntime': No module named 'onnxruntime'", False),
    ],
)
def test_only_reasons_of_the_list_are_accepted(why, accepted):
    assert skips.unknown([skipped(why)]) == ([] if accepted else [f"t.py::t: {why}"])


@pytest.mark.parametrize(("why", "known_skips", "status"), [(MISSING, True, 1), (MISSING, False, 0), (OF_CI, True, 0)])
def test_a_session_with_another_skip_fails(why, known_skips, status):
    lines = []
    reporter = SimpleNamespace(stats={"skipped": [skipped(why)]}, write_line=lambda line, **markup: lines.append(line))
    plugins = SimpleNamespace(get_plugin=lambda name: reporter)
    config = SimpleNamespace(pluginmanager=plugins, option=SimpleNamespace(known_skips=known_skips))
    session = SimpleNamespace(config=config, exitstatus=pytest.ExitCode.OK)
    skips.check(session)
    assert session.exitstatus == status
    assert bool(lines) == bool(status)
