"""A robot's computer, on which JAX is not installed: it records, deploys and reads logs."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from live_robots import PATIENT, manifest_of

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches import light as bench

from sim2real import errors
from sim2real.log.reader import read_log
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages.pipeline.pipeline import load_pipeline

pytestmark = pytest.mark.process

WITHOUT_JAX = (sys.executable, str(Path(__file__).parents[1] / "stages" / "without_jax.py"))
"""A command line that refuses what only the distribution sim2real brings."""


def call(command, folder, *arguments):
    """Run a command in a folder; return its exit code and its output."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_"))}
    line = [*command, *map(str, arguments)]
    done = subprocess.run(line, cwd=folder, env=outside, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module", params=["pendulum", pytest.param("so101", marks=pytest.mark.night)])
def resting(request, tmp_path_factory):
    """A robot, and a bundle whose policy rests; the aim of the SO-101 is drawn."""
    robot = load_pipeline(request.param).load()
    low, high = np.array([(a.low, a.high) for a in robot.agent.action]).T
    size, actions = robot.agent.observation_size, len(low)
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(actions)}
    weights |= {"layers.0.kernel": np.zeros((size, actions)), "layers.0.bias": np.zeros(actions)}
    terms = robot.agent.observation, robot.agent.action, robot.rate_hz
    contract = PolicyContract(*terms, limits=dict(robot.agent.limits))
    return request.param, save_bundle(tmp_path_factory.mktemp("bundle") / "resting", weights, contract)


def assert_works(command, folder, robot, bundle):
    """Record and deploy on the emulated robot, and read the log."""
    flags = ["--duration-s", "1", "--runs", "runs", *PATIENT]
    code, said = call(command, folder, "record", robot, *flags)
    assert code == errors.OK, said
    (log,) = folder.glob(f"runs/{robot}/*/record/session.mcap")
    recorded = read_log(log)
    assert len(recorded.steps["sensor"]) >= 40
    assert set(recorded.metadata["hardware"]["voltage"].values()) == {"12.0 V"}
    code, said = call(command, folder, "info", log)
    assert code == errors.OK, said
    code, said = call(command, folder, "check", robot)
    assert "samples in" in said
    assert code == errors.USAGE
    assert "computed with JAX" in said
    once = ["--bundle", bundle, "--episodes", "1", "--no-measure-delay"]
    code, said = call(command, folder, "deploy", robot, *flags, *once)
    assert code == errors.OK, said
    assert "no page: `sim2real report" in said
    (deployed,) = folder.glob(f"runs/{robot}/*/deploy")
    assert "success, deployment 0" in manifest_of(deployed)["summary"]


def test_a_robot_is_recorded_and_moved_by_a_policy_without_jax(tmp_path, resting):
    assert_works(WITHOUT_JAX, tmp_path, *resting)


@pytest.mark.night
def test_a_motion_from_a_table_is_played(tmp_path):
    servos = load_pipeline("so101").load("robot").SERVOS
    t_s = np.arange(0.0, 1.5, 0.02)
    goals = np.asarray(servos.middle) + 0.05 * np.sin(3.0 * t_s)[:, None]
    names = ",".join(["t_s", *(f"{name}_goal_rad" for name in servos.names)])
    np.savetxt(tmp_path / "motion.csv", np.column_stack([t_s, goals]), delimiter=",", header=names, comments="")
    code, said = call(WITHOUT_JAX, tmp_path, "record", "so101", "--excitation", "motion.csv", *PATIENT)
    assert code == errors.OK, said
    assert "which parameters this motion determines is not checked" in said


@pytest.mark.night
def test_a_motion_by_hand_is_recorded_and_seen_and_check_refuses_it(tmp_path):
    hand = ["--excitation", "hand", "--duration-s", "1", "--view", "live.rrd", *PATIENT]
    code, said = call(WITHOUT_JAX, tmp_path, "record", "so101", *hand)
    assert code == errors.OK, said
    assert "torque is off: move the robot by hand" in said
    assert (tmp_path / "live.rrd").stat().st_size > 1000
    (log,) = tmp_path.glob("runs/so101/*/record/session.mcap")
    code, said = call(WITHOUT_JAX, tmp_path, "check", "so101", "--log", log)
    assert code == errors.ERROR
    assert "was guided by hand: torque was off" in said
    assert "hint: play it and record that" in said
    code, said = call(WITHOUT_JAX, tmp_path, "view", log.parents[1], "--save", "run.rrd")
    assert code == errors.OK, said
    assert (tmp_path / "run.rrd").stat().st_size > 1000


@pytest.mark.night
def test_the_distribution_is_small_and_works(tmp_path_factory, tmp_path, resting):
    folder = tmp_path_factory.mktemp("light")
    command = [bench.installed(folder), "-P", "-m", "sim2real.cli"]
    assert bench.size_mb(folder) <= 300
    (packages,) = (folder / "env" / "lib").glob("python*/site-packages")
    assert not [name for name in ("jax", "brax", "scipy", "onnx", "matplotlib") if (packages / name).exists()]
    assert_works(command, tmp_path, *resting)
    code, said = call(command, tmp_path, "view", resting[0])
    assert (code, "pip install 'rerun-sdk" in said) == (errors.ERROR, True)
