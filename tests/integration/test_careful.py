"""A deployment that measures the delay first, is stopped softly, or meets a fault while the policy moves the robot."""

import os
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from live_robots import PATIENT, assert_torque_ends_off, manifest_of, motor

from sim2real import cli, errors
from sim2real.hardware.emulation.truth import Kind, read_truth
from sim2real.hardware.plant import OperatingMode
from sim2real.log.reader import read_log
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages.pipeline.pipeline import load_pipeline

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches import faults

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def resting(tmp_path_factory):
    """A bundle whose policy rests, trained with the delay that the pendulum has."""
    robot = load_pipeline("pendulum").load()
    size, low, high = robot.agent.observation_size, *np.array([(a.low, a.high) for a in robot.agent.action]).T
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(1)}
    weights |= {"layers.0.kernel": np.zeros((size, 1)), "layers.0.bias": np.zeros(1)}
    trained = {"round_trip_delay": (0.043, 0.047)}
    contract = PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz, trained_s=trained)
    return save_bundle(tmp_path_factory.mktemp("bundle") / "resting", weights, contract)


def deploy(name, bundle, root, *flags):
    """Deploy for a second; return the exit code and the stage's folder."""
    own = ["--bundle", str(bundle), "--episodes", "1", "--duration-s", "1", "--runs", str(root), *PATIENT]
    code = cli.main(["deploy", name, *own, *flags])
    (folder,) = (root / name).glob("*/deploy")
    return code, folder


def assert_steps_are_a_log(folder):
    """What was sent and measured while the delay was measured: 8 steps to both sides, at the robot's rate."""
    log = read_log(folder / "probe.mcap")
    volts = log.outputs["actuator"]["action"][:, 0]
    up = np.flatnonzero(np.diff(np.abs(volts)) > 1.0)
    assert up.size >= 8
    assert np.sign(volts[up + 1])[:8].tolist() == [1.0, -1.0] * 4
    t_s, moved = log.steps["sensor"].begun_s, np.unwrap(log.outputs["sensor"]["th"]) - np.pi
    assert np.diff(t_s).min() >= 1 / 50
    assert np.median(np.diff(t_s)) < 1.4 / 50
    left_s = log.steps["actuator"].end[up + 1] * 1e-6
    after = np.interp(left_s + 0.13, t_s, moved) * np.sign(volts[up + 1])
    assert np.median(after) > 0.07
    assert np.mean(after > 0.05) >= 0.75, "a busy machine may hold up an emulated motor's answer, rarely"
    soon = (t_s > left_s[:, None]) & (t_s < left_s[:, None] + 0.2)
    farthest = np.max(np.where(soon, moved * np.sign(volts[up + 1])[:, None], -np.inf), axis=1)
    assert np.all(farthest > 0.05), "each step is answered, in its direction"


@pytest.mark.night
def test_the_delay_is_measured_before_the_policy_moves_the_robot(tmp_path, resting):
    code, folder = deploy("pendulum", resting, tmp_path)
    assert code == errors.OK
    said = manifest_of(folder)["summary"]["measured delay"]
    assert 37 <= float(said.partition(" ms")[0]) <= 53
    assert_steps_are_a_log(folder)
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


@pytest.mark.night  # `make test` refuses a delay in test_admission.py, and measures one in the test above
def test_15_ms_more_of_delay_are_refused(make_pipeline, tmp_path, resting, capsys):
    latency = load_pipeline("pendulum").load().drive.embedded.emulator.actuation_latency_s + 0.015
    name = make_pipeline("late_pendulum", f"\n    embedded = faulty_emulator(actuation_latency_s={latency})\n")
    for turn in range(3):
        code, folder = deploy(name, resting, tmp_path / str(turn))
        assert code == errors.SAFETY_STOP
        said = capsys.readouterr().err
        assert "--force" in said
        if "delays that vary" not in said:  # what an emulated motor on a busy machine does, too
            break
    assert "the policy was trained with 43 to 47 ms" in said
    assert not (folder / "episode_0.mcap").exists(), "the policy never ran"
    assert_steps_are_a_log(folder)
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_ctrl_c_brings_the_motor_to_rest_before_the_torque_goes_off(tmp_path):
    robot, bundle = load_pipeline("pendulum").load().drive.embedded, faults.swinging_bundle(tmp_path / "bundle")
    for turn in range(3):
        runs, truth, said = (tmp_path / str(turn) / name for name in ("runs", "truth.bin", "said.txt"))
        runs.mkdir(parents=True)
        with faults.emulated(robot.emulator, robot.plant, truth) as (port, _):
            patient = ("--gate.stop-s=2", "--gate.max-sample-age-s=1")  # on a busy machine commands come late
            child = faults.deployed(port, bundle, runs, said, 0.4, *patient)
            faults.wait_until_moving(truth, said, child)
            time.sleep(0.5)
            if child.is_alive():
                os.kill(child.pid, signal.SIGINT)
            code = faults.ended(child)
        if "missed in a row" not in said.read_text():  # a busy machine may hold up an emulated motor for 0.1 s
            break
    assert code == 130, said.read_text()
    assert "coming to rest; Ctrl-C stops at once" in said.read_text()
    (log,) = runs.glob("pendulum/*/deploy/episode_0.mcap")
    _, modes, goals = motor(read_truth(truth))
    last = int(np.flatnonzero(modes == OperatingMode.PWM)[-1])
    assert modes[-1] == OperatingMode.OFF
    assert np.abs(goals[: last - 10]).max() > 0.3, "it swung at up to 2 of 5 V"
    assert abs(goals[last]) < 0.05, "the voltage had faded when the torque went off"
    assert read_log(log).complete


def test_a_robot_that_would_fall_is_held_until_it_is_let_go(tmp_path, start_cli):
    robot = load_pipeline("arm").load()
    size, low, high = robot.agent.observation_size, *np.array([(a.low, a.high) for a in robot.agent.action]).T
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(3)}
    weights |= {"layers.0.kernel": np.zeros((size, 3)), "layers.0.bias": np.full(3, 0.2)}
    bundle = save_bundle(
        tmp_path / "bundle", weights, PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz)
    )
    flags = ["--bundle", bundle, "--episodes", 1, "--duration-s", 1, "--runs", tmp_path, *PATIENT]
    process = start_cli("deploy", "arm", "--hold", *flags)
    assert any("holding: support the robot" in line for line in process.stderr)
    time.sleep(0.5)
    told_ns = time.monotonic_ns()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 130
    (path,) = tmp_path.glob("arm/*/deploy/truth.bin")
    effects = read_truth(path).of(Kind.EFFECT, 1)
    before, modes = effects["t_ns"] < told_ns, effects["values"][:, 0]
    held = effects["values"][before & (effects["t_ns"] > told_ns - 400_000_000)]
    assert len(held) > 5
    assert np.all(held[:, 0] == OperatingMode.POSITION)
    assert np.ptp(held[:, 1]) < 1e-6, "the goal stays"
    assert modes[-1] == OperatingMode.OFF


def test_a_robot_that_leans_too_far_is_stopped(make_pipeline, tmp_path, capsys):
    body = "\ndef tilt_rad(observation):\n    return float(np.arctan2(abs(observation[1]), -observation[0]))\n"
    name = make_pipeline("leaning_pendulum", body)  # from hanging down
    bundle = faults.swinging_bundle(tmp_path / "bundle")
    code, folder = deploy(name, bundle, tmp_path, "--max-tilt-rad", "1", "--duration-s", "10", "--no-measure-delay")
    assert code == errors.SAFETY_STOP
    said = capsys.readouterr().err
    leans = re.search(r"the robot leans by (\S+) rad, more than the 1 rad that are allowed", said)
    assert leans
    assert 1.0 <= float(leans[1]) < 2.0
    assert_torque_ends_off(read_truth(folder / "truth.bin"))
    assert read_log(folder / "episode_0.mcap").complete


def test_a_tilt_that_the_robot_does_not_see_is_refused(tmp_path, resting, capsys):
    flags = ["--bundle", str(resting), "--max-tilt-rad", "1", "--runs", str(tmp_path)]
    assert cli.main(["deploy", "pendulum", *flags]) == errors.USAGE
    assert "does not measure its tilt" in capsys.readouterr().err
    assert not (tmp_path / "pendulum").exists()


def test_the_motors_of_a_voltage_drive_hold_nothing(tmp_path, resting, capsys):
    code, folder = deploy("pendulum", resting, tmp_path, "--hold")
    assert code == errors.USAGE
    assert "hold no position" in capsys.readouterr().err
    assert manifest_of(folder)["status"] == "failed"
