"""``record`` and ``deploy`` on embedded robots: what moves, how it ends, what is written."""

import contextlib
import io
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import so101_person
from live_robots import assert_torque_ends_off, make_bundle, manifest_of

import sim2real
from sim2real import cli, errors
from sim2real.emulation.truth import Kind, read_truth
from sim2real.hardware.device import OperatingMode
from sim2real.log.reader import read_log
from sim2real.robots.nodes import Excitation
from sim2real.stages.deploy import episodes, stage
from sim2real.stages.load import load_module, load_robot
from sim2real.stages.session import episode
from sim2real.stages.session.excitation import played


@pytest.fixture
def clocks(monkeypatch):
    """The clocks of the episodes that a test runs on embedded robots."""
    made, kind = [], episode.VirtualClock
    monkeypatch.setattr(episode, "VirtualClock", lambda robot: made.append(kind(robot)) or made[-1])
    return made


def call(root, command, pipeline, *flags):
    """Run a stage; return its exit code, what it said, and its folder."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([command, pipeline, "--runs", str(root), *map(str, flags)])
    (folder,) = (root / pipeline).glob(f"*/{command}")
    return code, out.getvalue() + err.getvalue(), folder


def deploy(root, pipeline, bundle, *flags):
    return call(root, "deploy", pipeline, "--bundle", bundle, "--episodes", 1, *flags)


def test_strict_timing_ends_with_its_code_and_a_complete_log(tmp_path, clocks, monkeypatch):
    step = Excitation.step

    def slow(self, step_state):
        if step_state.seq % 10 == 9:
            clocks[0].event().wait(0.03)
        return step(self, step_state)

    monkeypatch.setattr(Excitation, "step", slow)
    code, _, folder = call(tmp_path, "record", "pendulum", "--duration-s", 1, "--strict-timing")
    assert code == errors.DEADLINE
    episode = read_log(folder / "session.mcap")
    assert episode.complete
    assert episode.metadata["log"]["session_end"]["timing"]["agent"]["overruns"] == 4
    assert (folder / "timing.json").is_file()
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_an_embedded_robot_does_the_same_each_time(tmp_path):
    first, second = (call(tmp_path / name, "record", "arm", "--duration-s", 2)[2] for name in "ab")
    assert (first / "truth.bin").read_bytes() == (second / "truth.bin").read_bytes()
    once, again = (read_log(folder / "session.mcap").steps["sensor"].start for folder in (first, second))
    assert len(once) == 100
    np.testing.assert_array_equal(once, again)


def test_a_dry_run_sends_nothing_that_moves_and_is_no_recording(tmp_path):
    """What a device without torque writes to its bus is in tests/hardware/test_rig.py."""
    flags = ["--duration-s", 1, "--amplitude", 2, "--gate.slew-per-s", 5]
    code, said, folder = call(tmp_path, "record", "pendulum", "--dry-run", *flags)
    assert code == 0
    assert "would have been sent to" in said
    assert read_truth(folder / "truth.bin").of(Kind.EFFECT).size == 0
    manifest = manifest_of(folder)
    assert (manifest["status"], manifest["dry_run"], manifest["exit_code"]) == ("dry run", True, 0)
    episode = read_log(folder / "session.mcap")
    assert episode.metadata["dry_run"] is True
    wanted, sent = episode.outputs["agent"]["command"][:, 0], episode.outputs["actuator"]["action"][:, 0]
    assert np.abs(wanted).max() > 1.0
    assert np.abs(sent).max() > 0.5
    (row,) = re.findall(r"^ *0 +hinge +V +50 +(\S+) +(\S+) +(\S+)$", said, re.MULTILINE)
    np.testing.assert_allclose([float(v) for v in row], [sent.min(), sent.mean(), sent.max()], rtol=1e-3)
    # No later stage takes it for a recording.
    assert cli.main(["identify", "pendulum", "--runs", str(tmp_path)]) == errors.ERROR
    for command in ("identify", "check"):
        log = ["--log", str(folder / "session.mcap")]
        assert cli.main([command, "pendulum", *log, "--runs", str(tmp_path)]) == errors.ERROR
    assert cli.main(["report", str(folder.parent)]) == 0
    assert "Dry run" in (folder.parent / "report.html").read_text(encoding="utf-8")


def test_a_robot_that_leans_too_far_is_stopped(tmp_path, monkeypatch):
    from_hanging = lambda observation: float(np.arctan2(abs(observation[1]), -observation[0]))  # noqa: E731
    for module in (episodes, stage):
        monkeypatch.setattr(module, "tilt_of", lambda observation: from_hanging)
    bundle = make_bundle("pendulum", tmp_path, 0.6, slope=40.0)  # it pumps
    code, said, folder = deploy(
        tmp_path, "pendulum", bundle, "--max-tilt-rad", 1, "--duration-s", 10, "--no-measure-delay"
    )
    assert code == errors.SAFETY_STOP
    assert 1.0 <= float(re.search(r"leans by (\S+) rad", said)[1]) < 1.5
    assert_torque_ends_off(read_truth(folder / "truth.bin"))
    assert read_log(folder / "episode_0.mcap").complete


def test_a_robot_that_would_fall_is_held_until_it_is_told(tmp_path, clocks, monkeypatch):
    held_ns = []

    def told():
        held_ns.append(clocks[0].monotonic_ns())
        return len(held_ns) > 25  # half a second

    monkeypatch.setattr(episode, "_enter_pressed", told)
    bundle = make_bundle("arm", tmp_path, 0.2)
    code, said, folder = deploy(tmp_path, "arm", bundle, "--hold", "--duration-s", 1)
    assert code == 0
    assert "holding: support the robot" in said
    effects = read_truth(folder / "truth.bin").of(Kind.EFFECT, 1)
    held = effects["values"][(effects["t_ns"] < held_ns[-1]) & (effects["t_ns"] > held_ns[0] + 50_000_000)]
    assert len(held) > 20
    assert np.all(held[:, 0] == OperatingMode.POSITION)
    assert np.ptp(held[:, 1]) < 1e-6, "the goal stays"
    assert effects["values"][-1, 0] == OperatingMode.OFF


def test_the_delay_is_measured_before_the_policy_moves_the_robot(tmp_path):
    code, _, folder = deploy(tmp_path, "pendulum", make_bundle("pendulum", tmp_path), "--duration-s", 1)
    assert code == errors.OK
    # The emulated robot's round trip takes 45 ms on average.
    assert float(manifest_of(folder)["summary"]["measured delay"].partition(" ms")[0]) == pytest.approx(45, abs=3)
    log = read_log(folder / "probe.mcap")
    volts = log.outputs["actuator"]["action"][:, 0]
    up = np.flatnonzero(np.diff(np.abs(volts)) > 1.0)
    assert np.sign(volts[up + 1])[:8].tolist() == [1.0, -1.0] * 4
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_what_this_robot_cannot_do_is_refused(tmp_path):
    bundle = make_bundle("pendulum", tmp_path)
    flags = ["--bundle", str(bundle), "--max-tilt-rad", "1", "--runs", str(tmp_path)]
    assert cli.main(["deploy", "pendulum", *flags]) == errors.USAGE
    assert not (tmp_path / "pendulum").exists()
    code, _, folder = deploy(tmp_path, "pendulum", bundle, "--hold")
    assert code == errors.USAGE
    assert manifest_of(folder)["status"] == "failed"


def test_a_recording_by_hand_has_no_command_and_no_torque(tmp_path):
    robot = load_robot("so101")
    embedded = robot.drive.embedded()
    start, t_s = np.array(load_module(robot.name, "plant").SO101Plant().data.qpos), np.arange(0.0, 4.0, 1 / 30)
    middle = (np.array(robot.drive.servos.low) + np.array(robot.drive.servos.high)) / 2
    pose = np.vstack([start, middle + 0.3 * np.sin(2 * np.pi * 0.2 * t_s[:, None] + np.arange(6))])
    np.savez(tmp_path / "hand.npz", t_s=np.concatenate([[0.0], 2.0 + t_s]), position=pose)
    changed = replace(embedded, plant=partial(so101_person.GuidedArm, tmp_path / "hand.npz"))
    arm = type(robot)()
    settings = load_module(robot.name, "robot").calibrated
    arm.drive = type(robot.drive)(robot.drive.servos, embedded=lambda: changed, settings=settings)
    recording = sim2real.record(arm, tmp_path / "log", {"excitation": "hand", "duration_s": 6.0})
    assert set(recording.episode.steps) == {"sensor"}
    position = recording.episode.outputs["sensor"]["position"]
    assert np.abs(np.ptp(position, axis=0) - np.ptp(pose, axis=0)).max() < 0.1, "the arm follows the hand"
    modes = read_truth(recording.path.with_name("truth.bin")).of(Kind.EFFECT)["values"][:, 0]
    assert set(modes.astype(int)) <= {int(OperatingMode.OFF)}, "the gate sent nothing"
    assert recording.episode.metadata["dry_run"] is True
    with pytest.raises(errors.Sim2RealError, match="guided by hand") as caught:
        sim2real.identify(arm, recording)
    assert "--excitation LOG" in caught.value.hint
    # As the hint says, its positions are a motion to play.
    motion = played(replace(robot.defaults.record, excitation=str(recording.path)), robot, announce=False)
    assert len(motion) > 150
