"""``--view``: the viewer gets all rows while the robot moves; a viewer that fails changes nothing in the log."""

import os
import signal
import socket
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
from live_robots import PATIENT, manifest_of

from sim2real import cli
from sim2real.artifacts.run.run_folder import newest
from sim2real.errors import UsageError
from sim2real.log.reader import read_log
from sim2real.stages.live.config import check_view

pytestmark = pytest.mark.process


def record(root, view, *, duration_s=2.0, pipeline="pendulum"):
    """Record, and return the folder of the recording, which must be whole."""
    flags = ["--duration-s", str(duration_s), "--runs", str(root), *PATIENT, "--gate.max-sample-age-s", "3", *view]
    assert cli.main(["record", pipeline, *flags]) == 0
    folder = newest(root, pipeline, "record").folder
    log = read_log(folder / "session.mcap")
    assert log.complete
    assert manifest_of(folder)["status"] == "finished"
    assert min(len(steps) for steps in log.steps.values()) > 0.8 * 50 * duration_s
    return folder, log


def viewers():
    """Return the numbers of the viewer processes that this process has started."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words, fields = (process / "cmdline").read_text(), (process / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if "viewer_process" in words and int(fields[1]) == os.getpid():
            found.append(int(process.name))
    return found


def when_recording(root, action, told):
    """Call an action for the viewer's process once the log grows, in a thread."""

    def wait():
        end_s = time.monotonic() + 60.0
        while time.monotonic() < end_s:
            logs = list(Path(root).glob("*/*/record/session.mcap"))
            if logs and logs[0].stat().st_size > 10_000 and (processes := viewers()):
                action(processes[0])
                told.append(processes[0])
                return
            time.sleep(0.02)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


@pytest.mark.night
@pytest.mark.parametrize("pipeline", ["pendulum", pytest.param("so101", marks=pytest.mark.night)])
def test_the_viewer_gets_every_signal_lateness_and_the_robot(tmp_path, pipeline):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    file = tmp_path / "live.rrd"
    _, log = record(tmp_path / "runs", ["--view", str(file)], pipeline=pipeline)
    rows, first = Counter(), set()
    for chunk in RrdReader(file).stream().to_chunks():
        rows[chunk.entity_path.replace("\\", "")] += 0 if chunk.is_static else chunk.num_rows
        first |= set(chunk.timeline_names)
    field, moving = {"pendulum": ("th", "turning"), "so101": ("position[3]", "body_4")}[pipeline]
    command = {"pendulum": "action", "so101": "goal[5]"}[pipeline]
    steps = len(log.steps["sensor"])
    assert rows[f"/record/session/sensor/{field}"] == steps
    assert rows[f"/record/session/actuator/{command}"] == len(log.steps["actuator"])
    assert rows["/record/session/lateness/agent"] == len(log.steps["agent"])
    assert rows[f"/record/session/scene/robot/{moving}"] == steps
    assert "time" in first
    assert viewers() == []


@pytest.mark.parametrize(
    ("number", "problem"),
    [
        (signal.SIGKILL, "its process ended early"),
        pytest.param(signal.SIGSTOP, "its process hangs", marks=pytest.mark.night),
    ],
)
def test_a_viewer_that_dies_or_hangs_costs_no_row(tmp_path, capsys, number, problem):
    told = []
    thread = when_recording(tmp_path / "runs", lambda pid: os.kill(pid, number), told)
    record(tmp_path / "runs", ["--view", str(tmp_path / "live.rrd")])
    thread.join()
    assert told
    assert f"the live view is not whole: {problem}" in capsys.readouterr().err
    assert viewers() == []


@pytest.mark.night  # `make test` stops a viewer's process, above
def test_a_viewer_that_reads_nothing_costs_no_row(tmp_path, capsys):
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        address = f"rerun+http://127.0.0.1:{deaf.getsockname()[1]}/proxy"
        record(tmp_path / "runs", ["--view", address])
    assert "the viewer did not take" in capsys.readouterr().err


@pytest.mark.night
def test_without_a_screen_the_recording_goes_on_and_names_another_viewer(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    record(tmp_path / "runs", ["--view"], duration_s=1.0)
    said = capsys.readouterr().err
    assert "no live view: this computer has no screen" in said
    assert "--view web" in said


def test_the_flag_takes_a_viewer():
    for view in (None, "window", "web", "web:0.0.0.0", "a/b.rrd", "rerun+http://laptop:9876/proxy"):
        check_view(view)
    with pytest.raises(UsageError, match="--view screen is no viewer"):
        check_view("screen")
