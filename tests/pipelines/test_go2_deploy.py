"""``sim2real deploy go2``: the shipped policy walks on the emulated Go2, over DDS, from lying to lying."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from pipelines.go2.robot import ROBOT
from sim2real import cli
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.recording import Recording
from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK
from sim2real.hardware.safety.gate import GateLimits
from sim2real.robots.walking.drive import StandUp

pytest.importorskip("cyclonedds")

GUIDE = Path(__file__).parents[2] / "docs/guides/walk.md"


@pytest.mark.night  # `make test` drives the device in test_unitree_device.py, and walks in test_walking.py
def test_the_shipped_policy_walks_and_lies_down(tmp_path, capsys):
    (command,) = re.findall(r"^    sim2real (deploy .*)$", GUIDE.read_text(), re.MULTILINE)
    assert cli.main([*shlex.split(command), "--runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert "its shipped policy is deployed" in output.err
    assert "verdict: fine" in output.err
    (deployed,) = (tmp_path / "go2").glob("*/deploy")
    # The report has the gap to the twin, and draws what was measured.
    page = (deployed.parent / "report.html").read_text()
    assert "velocity error" in page
    assert "yaw error" in page
    assert page.count("<svg") >= 3
    assert "are in the log" in page
    result = json.loads((deployed / "result.json").read_text())
    scores = result["episodes"][0]
    assert scores["real"]["success"] == scores["simulation"]["success"] == 1.0
    assert scores["real"]["velocity_error_m_s"] < 0.4
    # The true motion: it lies, stands up, walks as commanded, and lies again.
    recording = Recording.load(deployed / "episode_0.mcap", deployed / "truth.bin")
    _, states = recording.truth.states()
    height = states["base[2]"]
    assert height[:100].max() < 0.1
    assert height.max() > 0.28
    assert height[-20:].max() < 0.2
    t_s, walking = recording.true_states()
    aim = np.array([0.4, 0.0, 0.3])
    settled = (t_s > 1.0) & (t_s < 3.8)
    mean = np.array([walking[name][settled].mean() for name in ("linear[0]", "linear[1]", "gyro[2]")])
    assert np.abs(mean - aim).max() < 0.3
    # The log holds all columns of the commands, within the gate; on a busy machine a late command is replaced.
    sent = recording.episode.outputs["actuator"]
    assert set(sent) == {"q", "dq", "kp", "kd", "tau"}
    driven = 50 + np.flatnonzero((sent["kp"][50:] > 0.0).all(axis=1))
    assert len(driven) > 0.95 * (len(sent["kp"]) - 50)
    np.testing.assert_allclose(sent["kp"][driven], 35.0)
    np.testing.assert_allclose(sent["kd"][driven], 0.6, rtol=1e-6)


def test_all_trials_of_a_commanded_robot_have_one_command_within_the_policys():
    robot = ROBOT.commanded((0.4, 0.0, 0.3))
    for trial in (0, 7):
        np.testing.assert_array_equal(robot.task.at_rest(trial).aim, np.tile(np.float32([0.4, 0.0, 0.3]), 4))
        np.testing.assert_array_equal(ROBOT.task.at_rest(trial).aim, ROBOT.commands.of_trial(trial))
    with pytest.raises(UsageError, match="velocities of at most"):
        ROBOT.commanded((0.4, 0.7, 0.0))


def test_a_robot_that_does_not_walk_refuses_a_velocity(tmp_path, capsys):
    deploy = ["deploy", "pendulum", "--command", "0.4", "0", "0", "--runs", str(tmp_path)]
    assert cli.main(deploy) == 2
    assert "follows no velocity" in capsys.readouterr().err


@pytest.mark.night
def test_a_run_records_identifies_and_deploys_the_shipped_policy(tmp_path, capsys):
    """The smaller tests are those of the model in a stand, of the run's stages, and of the deployment above."""
    (command,) = re.findall(r"`sim2real (run go2[^`]*)`", GUIDE.read_text())
    assert cli.main([*shlex.split(command), "--runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert "ships a policy, and JAX has no GPU" in output.err
    (run,) = (tmp_path / "go2").iterdir()
    found = Identification.load(run / "identify")
    assert found.verdict.status == "accepted"
    # The base is fixed, in the air, and every joint follows its targets, which begin where it hangs.
    recording = Recording.load(run / "record")
    height = recording.truth.states()[1]["base[2]"]
    assert np.ptp(height) == 0.0 < 0.9 < height[0]
    sent, measured = recording.episode.outputs["actuator"]["q"], recording.episode.outputs["sensor"]["position"]
    assert (np.abs(sent[1] - measured[0]) < 0.1).all()
    assert (np.ptp(measured, axis=0) > 0.1).all()
    assert "not determined by this log: foot_friction, payload, roughness" in found.verdict.reasons
    names = [p for p in found.parameters if p.kind == "dynamics" and p.state != "fixed"]
    assert len(names) == 21
    for p in names:
        assert p.estimate == pytest.approx(p.truth, rel=0.2), p.name  # of 6 s, on a busy machine
    trip = next(p for p in found.parameters if p.name == ROUND_TRIP)
    assert trip.estimate == pytest.approx(trip.truth, abs=0.001)
    deployment = Deployment.read(run / "deploy")
    assert deployment.verdict.status == "fine"
    assert "does not test the model" in deployment.reasons[-1]


@pytest.mark.night  # test_weighing.py has the load from a log of the emulator's clock
def test_the_load_of_a_robot_on_its_feet(tmp_path, capsys):
    logs = []
    for number, excitation in enumerate(("multisine", "standing")):
        line = ["record", "go2", "--excitation", excitation, "--runs", str(tmp_path / str(number))]
        assert cli.main(line) == 0
        logs += (tmp_path / str(number)).glob("go2/*/record/session.mcap")
    line = ["identify", "go2", "--log", str(logs[0]), "--standing", str(logs[1]), "--runs", str(tmp_path)]
    assert cli.main(line) == 0
    (folder,) = (tmp_path / "go2").glob("*/identify")
    found = Identification.load(folder)
    assert "not determined by this log: foot_friction, roughness" in found.verdict.reasons
    load = found.parameters[-1]
    assert load.name == "payload"
    assert load.estimate == pytest.approx(load.truth, abs=0.15)
    assert load.high95 - load.low95 < 0.8
    manifest = json.loads((folder / "manifest.json").read_text())
    assert "standing" in manifest["inputs"]
    # Without a log in a stand nothing else is known of the joints.
    capsys.readouterr()
    assert cli.main(["identify", "go2", "--log", str(logs[1]), "--runs", str(tmp_path)]) == 1
    assert "give a log on its feet as --standing" in capsys.readouterr().err


def test_the_gate_has_the_range_of_each_joint():
    from sim2real.hardware.unitree.device import UnitreeLegs

    gate = ROBOT.drive.gate(GateLimits(limit=4.6, slew_per_s=50.0), UnitreeLegs("lo:7"))
    low, high = gate.range
    np.testing.assert_allclose(low[:3, 0], [-1.0472, -1.5708, -2.7227])
    np.testing.assert_allclose(high[6:9, 0], [1.0472, 4.5379, -0.83776])
    assert list(gate.slew_per_s) == [50.0, *[np.inf] * 4]
    assert (low[:, 2:4] == 0.0).all()


def test_a_robot_without_a_device_is_refused():
    bodiless = type("Bodiless", (type(ROBOT),), {"motors": None})()
    with pytest.raises(UsageError, match="no device for port 'eth0'"):
        bodiless.drive.device("eth0", 0.1, embedded=False)


def test_the_start_motion_folds_the_legs_and_rises():
    motion, start, folded, stance = StandUp(1.0, 2.0, 0.5), np.zeros(2), np.array([1.0, -2.0]), np.array([0.5, -1.0])
    np.testing.assert_allclose(motion.targets(0.5, start, folded, stance), folded / 2)
    np.testing.assert_allclose(motion.targets(2.0, start, folded, stance), (folded + stance) / 2)
    np.testing.assert_allclose(motion.targets(3.5, start, folded, stance), stance)
    assert motion.duration_s == 3.5


def test_a_robot_that_tips_over_is_stopped_while_it_stands_up():
    class Rig:
        torque_withheld, clock = False, SYSTEM_CLOCK

        def measure(self):
            from types import SimpleNamespace

            return SimpleNamespace(position_rad=np.zeros(12), parts={"quaternion": np.array([0.5, 0.87, 0.0, 0.0])})

    with pytest.raises(SafetyStop, match="tipped over"):
        ROBOT.drive.begin(Rig())


def test_the_score_of_a_walk_compares_at_the_times_of_the_commands():
    t_s = np.arange(0.0, 4.0, 0.005)
    aim = np.repeat([[0.5, 0.0, 0.2], [-0.5, 0.3, -0.4]], 100, axis=0)  # 2 s each, at 50 Hz
    moved = np.where((t_s < 2.0)[:, None], aim[0], aim[150])
    states = {f"aim[{i}]": aim[:, i] for i in range(3)}
    states |= {"linear[0]": moved[:, 0], "linear[1]": moved[:, 1], "gyro[2]": moved[:, 2]}
    states |= {f"quaternion[{i}]": np.full(len(t_s), float(i == 0)) for i in range(4)}
    score = ROBOT.task.score(t_s, states)
    assert score == pytest.approx({"success": 1.0, "tilt_rad": 0.0, "velocity_error_m_s": 0.0, "yaw_error_rad_s": 0.0})
    late = ROBOT.task.score(t_s, {**states, "gyro[2]": moved[:, 2] + 0.1})
    assert late["yaw_error_rad_s"] == pytest.approx(0.1)
    del states["linear[0]"]
    assert np.isnan(ROBOT.task.score(t_s, states)["velocity_error_m_s"])
