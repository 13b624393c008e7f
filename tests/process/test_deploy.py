"""``deploy`` on a robot that is a process: SIGTERM, a robot that leans, a robot that would fall, the measured delay."""

import re
import signal
import time

import numpy as np
import pytest
from live_robots import PATIENT, assert_torque_ends_off, manifest_of, wait_until_running

from sim2real import cli, errors
from sim2real.emulation.truth import Kind, read_truth
from sim2real.hardware.device import OperatingMode
from sim2real.log.reader import read_log
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages.pipeline.pipeline import load_pipeline

pytestmark = pytest.mark.process


def make_bundle(name, folder, bias, slope=None):
    """Write a bundle whose policy gives the same action always, or one that grows with an observation."""
    robot = load_pipeline(name).load()
    size, low, high = robot.agent.observation_size, *np.array([(a.low, a.high) for a in robot.agent.action]).T
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(len(low))}
    kernel = np.zeros((size, len(low)))
    if slope:
        kernel[2] = slope  # thdot / 10: it pumps the pendulum
    trained = {"round_trip_delay": (0.043, 0.047)} if name == "pendulum" else {}
    contract = PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz, trained_s=trained)
    layers = {"layers.0.kernel": kernel, "layers.0.bias": np.full(len(low), bias)}
    return save_bundle(folder / "bundle", weights | layers, contract)


def deploy(name, bundle, root, *flags):
    """Deploy once; return the exit code and the stage's folder."""
    code = cli.main(["deploy", name, "--bundle", str(bundle), "--episodes", "1", "--runs", str(root), *PATIENT, *flags])
    (folder,) = (root / name).glob("*/deploy")
    return code, folder


def test_sigterm_ends_a_deployment_in_order(tmp_path, start_cli):
    flags = ["--bundle", make_bundle("pendulum", tmp_path, 0.5), "--duration-s", 20, "--no-measure-delay", *PATIENT]
    process = start_cli("deploy", "pendulum", *flags, "--runs", tmp_path)
    log = wait_until_running(tmp_path, "pendulum/*/deploy/episode_0.mcap", process)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)
    assert process.returncode == 143
    manifest = manifest_of(log.parent)
    assert (manifest["status"], manifest["exit_code"]) == ("interrupted", 143)
    assert read_log(log).metadata["log"]["session_end"]["exit_code"] == 143
    assert_torque_ends_off(read_truth(log.parent / "truth.bin"))


def test_a_robot_that_leans_too_far_is_stopped(make_pipeline, tmp_path, capsys):
    body = "\ndef tilt_rad(observation):\n    return float(np.arctan2(abs(observation[1]), -observation[0]))\n"
    name = make_pipeline("leaning_pendulum", body)  # from hanging down
    bundle = make_bundle("pendulum", tmp_path, 0.6, slope=40.0)
    code, folder = deploy(name, bundle, tmp_path, "--max-tilt-rad", "1", "--duration-s", "10", "--no-measure-delay")
    assert code == errors.SAFETY_STOP
    leans = re.search(r"leans by (\S+) rad", capsys.readouterr().err)
    assert leans
    assert 1.0 <= float(leans[1]) < 2.0
    assert_torque_ends_off(read_truth(folder / "truth.bin"))
    assert read_log(folder / "episode_0.mcap").complete


@pytest.mark.night
def test_a_robot_that_would_fall_is_held_until_ctrl_c(tmp_path, start_cli):
    flags = ["--bundle", make_bundle("arm", tmp_path, 0.2), "--episodes", 1, "--duration-s", 1, "--runs", tmp_path]
    process = start_cli("deploy", "arm", "--hold", *flags, *PATIENT)
    said = ""
    while "holding: support the robot" not in said:
        said += (line := process.stderr.readline())
        assert line, said
    time.sleep(0.5)
    told_ns = time.monotonic_ns()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 130
    (path,) = tmp_path.glob("arm/*/deploy/truth.bin")
    effects = read_truth(path).of(Kind.EFFECT, 1)
    held = effects["values"][(effects["t_ns"] < told_ns) & (effects["t_ns"] > told_ns - 400_000_000)]
    assert len(held) > 5
    assert np.all(held[:, 0] == OperatingMode.POSITION)
    assert np.ptp(held[:, 1]) < 1e-6, "the goal stays"
    assert effects["values"][-1, 0] == OperatingMode.OFF


@pytest.mark.night
def test_the_delay_is_measured_before_the_policy_moves_the_robot(tmp_path):
    code, folder = deploy("pendulum", make_bundle("pendulum", tmp_path, 0.0), tmp_path, "--duration-s", "1")
    assert code == errors.OK
    measured = manifest_of(folder)["summary"]["measured delay"]
    assert 37 <= float(measured.partition(" ms")[0]) <= 53
    log = read_log(folder / "probe.mcap")
    volts = log.outputs["actuator"]["action"][:, 0]
    up = np.flatnonzero(np.diff(np.abs(volts)) > 1.0)
    assert np.sign(volts[up + 1])[:8].tolist() == [1.0, -1.0] * 4
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_what_this_robot_cannot_do_is_refused(tmp_path, capsys):
    bundle = make_bundle("pendulum", tmp_path, 0.0)
    flags = ["--bundle", str(bundle), "--max-tilt-rad", "1", "--runs", str(tmp_path)]
    assert cli.main(["deploy", "pendulum", *flags]) == errors.USAGE
    assert "tilt" in capsys.readouterr().err
    assert not (tmp_path / "pendulum").exists()
    code, folder = deploy("pendulum", bundle, tmp_path, "--hold")
    assert code == errors.USAGE
    assert manifest_of(folder)["status"] == "failed"
