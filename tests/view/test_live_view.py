"""``--view`` while a robot moves: the viewer gets all rows; without one the stage goes on as before.

A viewer that is killed is in tests/process/test_stages.py.
"""

import socket
from collections import Counter

import pytest
from live_robots import manifest_of

from sim2real import cli
from sim2real.artifacts.run import newest
from sim2real.errors import UsageError
from sim2real.log.reader import read_log
from sim2real.stages.flag import check_view


def record(root, view, *, duration_s=2.0, pipeline="pendulum"):
    """Record, and return the log, which must be whole."""
    assert cli.main(["record", pipeline, "--duration-s", str(duration_s), "--runs", str(root), *view]) == 0
    folder = newest(root, pipeline, "record").folder
    log = read_log(folder / "session.mcap")
    assert log.complete
    assert manifest_of(folder)["status"] == "finished"
    assert {len(steps) for steps in log.steps.values()} == {round(50 * duration_s)}
    return log


@pytest.mark.night
@pytest.mark.parametrize("pipeline", ["pendulum", "so101"])
def test_the_viewer_gets_every_signal_lateness_and_the_robot(tmp_path, pipeline):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    file = tmp_path / "live.rrd"
    log = record(tmp_path / "runs", ["--view", str(file)], pipeline=pipeline)
    rows, first = Counter(), set()
    for chunk in RrdReader(file).stream().to_chunks():
        rows[chunk.entity_path.replace("\\", "")] += 0 if chunk.is_static else chunk.num_rows
        first |= set(chunk.timeline_names)
    field, moving = {"pendulum": ("th", "body_1"), "so101": ("position[3]", "body_4")}[pipeline]
    command = {"pendulum": "action", "so101": "goal[5]"}[pipeline]
    steps = len(log.steps["sensor"])
    assert rows[f"/record/session/sensor/{field}"] == steps
    assert rows[f"/record/session/actuator/{command}"] == len(log.steps["actuator"])
    assert rows["/record/session/lateness/agent"] == len(log.steps["agent"])
    assert rows[f"/record/session/scene/robot/{moving}"] == steps
    assert "time" in first


@pytest.mark.night  # it waits for the viewer
def test_a_viewer_that_reads_nothing_costs_no_row(tmp_path, capsys):
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        address = f"rerun+http://127.0.0.1:{deaf.getsockname()[1]}/proxy"
        record(tmp_path / "runs", ["--view", address])
    assert "the viewer did not take" in capsys.readouterr().err


@pytest.mark.night  # the viewer is a process
def test_without_a_screen_the_recording_goes_on_and_names_another_viewer(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    record(tmp_path / "runs", ["--view"], duration_s=1.0)
    said = capsys.readouterr().err
    assert "no live view: this computer has no screen" in said
    assert "--view web" in said
    assert said.count("hint: ") == 1


def test_the_flag_takes_a_viewer():
    for view in (None, "window", "web", "web:0.0.0.0", "a/b.rrd", "rerun+http://laptop:9876/proxy"):
        check_view(view)
    with pytest.raises(UsageError, match="--view screen is no viewer"):
        check_view("screen")
