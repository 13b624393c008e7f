"""The host dies, or is told to stop, at a random moment."""

import random
import signal
import time
import warnings

import numpy as np
import pytest
from live_robots import PATIENT, assert_torque_ends_off, manifest_of, motor, wait_until_running

from sim2real.artifacts.run.manifest import read_manifest
from sim2real.errors import SAFETY_STOP
from sim2real.hardware.emulation.truth import Kind, read_truth
from sim2real.hardware.plant import OperatingMode
from sim2real.log.reader import TruncatedLogWarning, read_log

pytestmark = pytest.mark.process


def check_death(log, killed_ns, truth):
    """The log holds all but the last 0.25 s before the death, and the motor stopped within 0.2 s of it."""
    with pytest.warns(TruncatedLogWarning, match="has no end"):
        episode = read_log(log)
    assert not any(episode.metadata["log"]["missing_steps"].values())
    to_monotonic_ns = time.monotonic_ns() - time.time_ns() + episode.metadata["log"]["epoch_ns"]
    for name, steps in episode.steps.items():
        logged_ns = to_monotonic_ns + 1000 * int(steps.end[-1])
        assert (killed_ns - logged_ns) * 1e-9 < 0.25, name
    # Every command that reached the motor until then stands in the log.
    effects = truth.of(Kind.EFFECT)
    arrived_ns = effects["t_host_ns"][(effects["t_host_ns"] > 0) & (effects["values"][:, 1] != 0.0)]
    ends_ns = to_monotonic_ns + 1000 * episode.steps["actuator"].end
    starts_ns = to_monotonic_ns + 1000 * episode.steps["actuator"].start
    inside = arrived_ns[(arrived_ns >= starts_ns[0]) & (arrived_ns < killed_ns - 250_000_000)]
    assert len(inside) > 10
    step = np.searchsorted(starts_ns, inside, side="right") - 1
    assert np.all(inside <= ends_ns[step])
    assert_off_soon(truth, killed_ns)


def assert_off_soon(truth, since_ns):
    """The guardian took the torque off: this servo goes on turning by itself."""
    t_ns, modes, _ = motor(truth)
    off = np.flatnonzero((modes == OperatingMode.OFF) & (t_ns > since_ns))
    assert off.size
    assert (t_ns[off[0]] - since_ns) * 1e-9 < 0.2
    assert np.all(modes[off[0] :] == OperatingMode.OFF)


@pytest.mark.night
def test_a_recording_that_is_stopped_and_wakes_again_ends_in_order(tmp_path, lone_robot, start_cli):
    port, end_robot = lone_robot
    process = start_cli("record", "pendulum", "--port", port, "--duration-s", 20, "--runs", tmp_path)
    log = wait_until_running(tmp_path, "pendulum/*/record/session.mcap", process)
    since_ns = time.monotonic_ns()
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.4)
    process.send_signal(signal.SIGCONT)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == SAFETY_STOP
    assert "the guardian has taken the torque off: this process was silent for 0.1 s" in said
    assert "if this process dies: XL330-M077 (servo 1) notices after 0.1 s, but goes on" in said
    assert_off_soon(end_robot(), since_ns)
    assert (manifest_of(log.parent)["status"], read_log(log).complete) == ("failed", True)


def test_kill_9_of_record(tmp_path, lone_robot, start_cli):
    port, end_robot = lone_robot
    flags = ["--port", port, "--duration-s", 20, "--runs", tmp_path, *PATIENT]
    process = start_cli("record", "pendulum", *flags)
    log = wait_until_running(tmp_path, "pendulum/*/record/session.mcap", process)
    time.sleep(random.Random(1).uniform(0.5, 1.5))
    killed_ns = time.monotonic_ns()
    process.kill()
    time.sleep(0.5)
    check_death(log, killed_ns, end_robot())
    assert manifest_of(log.parent)["status"] == "running", "nobody wrote that it ended"
    manifest = read_manifest(log.parent)
    assert manifest is not None
    assert manifest["status"] == "died"


def test_kill_9_of_deploy(tmp_path, lone_robot, start_cli, finished_run_dir):
    port, end_robot = lone_robot
    bundle = finished_run_dir / "train" / "bundle"
    flags = ["--port", port, "--bundle", bundle, "--duration-s", 20, "--runs", tmp_path, *PATIENT, "--no-measure-delay"]
    process = start_cli("deploy", "pendulum", *flags)
    log = wait_until_running(tmp_path, "pendulum/*/deploy/episode_0.mcap", process)
    time.sleep(random.Random(3).uniform(0.5, 1.5))
    killed_ns = time.monotonic_ns()
    process.kill()
    time.sleep(0.5)
    check_death(log, killed_ns, end_robot())


@pytest.mark.parametrize(("number", "code", "twice"), [(signal.SIGINT, 130, True), (signal.SIGTERM, 143, False)])
def test_signals_end_a_recording_in_order(tmp_path, start_cli, number, code, twice):
    process = start_cli("record", "pendulum", "--duration-s", 20, "--runs", tmp_path, *PATIENT)
    log = wait_until_running(tmp_path, "pendulum/*/record/session.mcap", process)
    process.send_signal(number)
    if twice:
        time.sleep(0.01)
        process.send_signal(number)
    process.communicate(timeout=20)
    assert process.returncode == code
    manifest = manifest_of(log.parent)
    assert (manifest["status"], manifest["exit_code"]) == ("interrupted", code)
    assert "log" in manifest["outputs"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode = read_log(log)
    end = episode.metadata["log"]["session_end"]
    assert end["exit_code"] == code
    assert end["status"].split(":")[0] in ("KeyboardInterrupt", "SystemExit")
    assert end["timing"]["sensor"]["steps"] == len(episode.steps["sensor"])
    assert_torque_ends_off(read_truth(log.parent / "truth.bin"))
