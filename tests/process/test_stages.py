"""``record`` and ``deploy`` as processes, on robots that are processes too: how they end, and what they leave.

What they do while nobody disturbs them is tested in virtual time, in tests/stages/test_on_robot.py.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from live_robots import assert_torque_ends_off, make_bundle, manifest_of
from patience import PATIENT, wait_until_running

from sim2real import cli, errors
from sim2real.artifacts.run import StageFolder, newest
from sim2real.emulation.truth import Kind, read_truth
from sim2real.log.reader import TruncatedLogWarning, read_log

pytestmark = pytest.mark.process
LOG = "pendulum/*/record/session.mcap"


def assert_ended_in_order(folder, log, code):
    manifest = manifest_of(folder)
    assert (manifest["status"], manifest["exit_code"]) == ("interrupted", code)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode = read_log(log)
    end = episode.metadata["log"]["session_end"]
    assert end["exit_code"] == code
    assert end["timing"]["sensor"]["steps"] == len(episode.steps["sensor"])
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_ctrl_c_twice_ends_a_recording_in_order(tmp_path, start_cli):
    process = start_cli("record", "pendulum", "--duration-s", 3600, "--runs", tmp_path)
    log = wait_until_running(tmp_path, LOG, process)
    process.send_signal(signal.SIGINT)
    time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode == 130
    assert_ended_in_order(log.parent, log, 130)


def test_sigterm_ends_a_deployment_in_order(tmp_path, start_cli):
    flags = ["--bundle", make_bundle("pendulum", tmp_path, 0.5), "--duration-s", 3600, "--no-measure-delay"]
    process = start_cli("deploy", "pendulum", *flags, "--runs", tmp_path)
    log = wait_until_running(tmp_path, "pendulum/*/deploy/episode_0.mcap", process)
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == 143
    assert_ended_in_order(log.parent, log, 143)


@pytest.mark.night
def test_a_killed_recording_leaves_what_was_written(tmp_path, lone_robot, start_cli):
    """How much is lost at most is tested for the log's writer, in tests/log/test_log_damage.py."""
    process = start_cli(
        "record", "pendulum", "--port", lone_robot.port, "--duration-s", 60, "--runs", tmp_path, *PATIENT
    )
    log = wait_until_running(tmp_path, LOG, process)
    process.kill()
    process.wait()
    stage = StageFolder.read(log.parent)
    assert stage is not None
    assert stage.manifest.status == "died"
    with pytest.warns(TruncatedLogWarning, match="has no end"):
        episode = read_log(log)
    # Each command that reached the motor in this time stands in the log.
    lone_robot.stop()
    effects, monotonic_ns = lone_robot.truth().of(Kind.EFFECT), time.monotonic_ns() - time.time_ns()
    arrived_us = (effects["t_host_ns"] - monotonic_ns - episode.metadata["log"]["epoch_ns"]) / 1e3
    steps = episode.steps["actuator"]
    inside = arrived_us[(arrived_us >= steps.start[0] + 1e3) & (arrived_us < steps.end[-1] - 1e3)]
    assert len(inside) > 0
    last = np.searchsorted(steps.start, inside + 1e3, side="right") - 1  # the wall clock may have moved a little
    assert np.all(inside <= steps.end[last] + 1e3)


def test_an_unplugged_bus_ends_the_recording(tmp_path, lone_robot, start_cli):
    process = start_cli(
        "record", "pendulum", "--port", lone_robot.port, "--duration-s", 60, "--runs", tmp_path, *PATIENT
    )
    log = wait_until_running(tmp_path, LOG, process)
    lone_robot.stop()  # with its end of the terminal
    said = process.communicate()[1]
    assert process.returncode == errors.HARDWARE_LOST
    assert "Traceback" not in said
    episode = read_log(log)
    assert episode.complete
    assert episode.metadata["log"]["session_end"]["exit_code"] == errors.HARDWARE_LOST
    assert manifest_of(log.parent)["exit_code"] == errors.HARDWARE_LOST


def viewers():
    """Return the numbers of the viewer processes that this process has started."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words, fields = (process / "cmdline").read_text(), (process / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if "sim2real.stages.live" in words and int(fields[1]) == os.getpid():
            found.append(int(process.name))
    return found


def test_a_viewer_that_is_killed_costs_no_row(tmp_path, capsys):
    killed = []

    def kill_the_viewer():
        while not killed:
            logs = [log for log in tmp_path.glob("runs/" + LOG) if log.stat().st_size > 10_000]
            killed.extend(viewers() if logs else ())
            time.sleep(0.02)
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill_the_viewer, daemon=True)
    thread.start()
    flags = ["--duration-s", "60", "--runs", str(tmp_path / "runs"), "--view", str(tmp_path / "live.rrd")]
    assert cli.main(["record", "pendulum", *flags]) == 0
    thread.join()
    folder = newest(tmp_path / "runs", "pendulum", "record").folder
    log = read_log(folder / "session.mcap")
    assert log.complete
    assert manifest_of(folder)["status"] == "finished"
    made = log.metadata["log"]["session_end"]["timing"]
    assert {name: len(steps) for name, steps in log.steps.items()} == {n: row["steps"] for n, row in made.items()}
    assert "the live view is not whole: its process ended early" in capsys.readouterr().err
    assert viewers() == []


@pytest.mark.night
def test_a_robot_is_recorded_and_moved_by_a_policy_without_jax(tmp_path):
    without_jax = Path(__file__).parents[1] / "stages" / "without_jax.py"

    def call(*arguments):
        outside = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_"))}
        line = [sys.executable, without_jax, *map(str, arguments)]
        done = subprocess.run(line, cwd=tmp_path, env=outside, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    flags = ["--duration-s", "1", "--runs", "runs"]
    code, said = call("record", "pendulum", *flags)
    assert code == errors.OK, said
    (log,) = tmp_path.glob("runs/" + LOG)
    assert read_log(log).complete
    code, said = call("info", log)
    assert code == errors.OK, said
    once = ["--bundle", make_bundle("pendulum", tmp_path), "--episodes", "1", "--no-measure-delay"]
    code, said = call("deploy", "pendulum", *flags, *once)
    assert code == errors.OK, said
    (deployed,) = tmp_path.glob("runs/pendulum/*/deploy")
    assert "success, episode 0" in manifest_of(deployed)["summary"]
