"""A dry run: everything of a real one, but not one instruction that could move a motor, however it ends."""

import contextlib
import io
import json
import os
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live_robots import manifest_of
from wiretap import Wiretap

from sim2real import cli
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.hardware.emulation.embedded import EmbeddedRobot
from sim2real.hardware.emulation.truth import Kind
from sim2real.hardware.plant import OperatingMode
from sim2real.log.reader import read_log
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages.pipeline.pipeline import load_pipeline

pytestmark = pytest.mark.process

GUIDES = Path(__file__).parents[2] / "docs" / "guides"
PATIENT = ["--gate.servo-watchdog-s", "0.6"]  # a busy machine is not what is tested


@pytest.fixture(scope="module")
def tapped(tmp_path_factory):
    """Start an emulated pendulum behind a wiretap."""
    embedded = load_pipeline("pendulum").load().drive.embedded
    with contextlib.ExitStack() as stack:

        def start():
            truth = tmp_path_factory.mktemp("robot") / "truth.bin"
            robot = stack.enter_context(EmbeddedRobot(embedded.plant, embedded.emulator, None, truth))
            tap = Wiretap(robot.port)
            stack.callback(tap.close)
            return tap, robot

        yield start


def test_the_wiretap_hears_what_moves_a_motor(tapped):
    tap, _ = tapped()
    with ServoBus(BusConfig(tap.port, reply_timeout_s=0.2, max_silence_s=1.0, silence_s=1.0)) as bus:
        bus.handshake({1: None})
        bus.setup(OperatingMode.PWM)
        assert tap.motions() == []
        bus.torque(True)
        bus.write_goal_pwm({1: 0.0})
        bus.write_goal_pwm({1: 0.0, 2: 0.0})
        bus.read_state()
    assert [(address, data) for _, address, data in tap.motions()] == [
        *[(reg.GOAL_PWM.address, b"\0\0"), (reg.TORQUE_ENABLE.address, b"\1")],
        *[(reg.GOAL_PWM.address, b"\0\0")] * 3,
    ]


def call(*arguments):
    """Run a command; return its exit code and what it said."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([str(a) for a in arguments])
    return code, out.getvalue(), err.getvalue()


def from_page(page):
    """Return the command of a guide's dry run."""
    lines = [line.strip() for line in (GUIDES / page).read_text(encoding="utf-8").splitlines()]
    (command,) = [line for line in lines if line.startswith("$ sim2real ") and "--dry-run" in line]
    return command.split()[2:]


def on(port, command, *more):
    at = command.index("--port")
    return [*command[: at + 1], port, *command[at + 2 :], *PATIENT, *more]


def nothing_moved(tap, robot):
    """Not one packet could have moved the motor, and the emulator's plant was never told anything."""
    assert tap.motions() == []
    assert len(tap.packets) > 30
    assert tap.torque_offs() >= 2, "torque is taken off at both ends, as always"
    assert robot.truth().of(Kind.EFFECT).size == 0


@pytest.fixture(scope="module")
def recorded(tapped, tmp_path_factory):
    """A dry recording by the guide's own command."""
    tap, robot = tapped()
    runs = tmp_path_factory.mktemp("runs")
    flags = ["--duration-s", 1, "--amplitude", 2, "--gate.slew-per-s", 5, "--runs", runs]
    code, out, err = call(*on(tap.port, from_page("record.md"), *flags))
    assert code == 0, err
    (folder,) = runs.glob("pendulum/*/record")
    return SimpleNamespace(tap=tap, robot=robot, runs=runs, folder=folder, out=out, err=err)


def test_nothing_that_moves_is_sent_while_recording(recorded):
    nothing_moved(recorded.tap, recorded.robot)


def test_the_log_holds_what_would_have_been_sent_and_says_that_it_was_not(recorded):
    episode = read_log(recorded.folder / "session.mcap")
    assert episode.metadata["dry_run"] is True
    assert [e["kind"] for e in episode.metadata["log"]["events"]] == ["dry run"]
    wanted, sent = (episode.outputs[n]["action"][:, 0] for n in ("agent", "actuator"))
    assert np.abs(wanted).max() > 1.0
    assert np.abs(sent).max() > 0.5
    (row,) = episode.metadata["log"]["session_end"]["sent"]
    assert (row["name"], row["unit"], row["commands"]) == ("hinge", "V", len(sent))
    np.testing.assert_allclose([row["low"], row["mean"], row["high"]], [sent.min(), sent.mean(), sent.max()], atol=1e-6)
    assert 0 < row["cut"] <= episode.metadata["log"]["session_end"]["gate"]["slewed"]
    assert np.ptp(episode.outputs["sensor"]["th"]) < 0.01
    assert episode.metadata["log"]["session_end"]["suspects"] == [], "it stands still as nothing pushes it"


def test_the_console_says_so_at_both_ends(recorded):
    assert recorded.err.startswith("recording 1 s of multisine")
    assert "dry run: torque stays off and no goal is sent; what would have been sent is logged" in recorded.err
    assert "dry run: no joint was moved; no later stage uses this as a recording" in recorded.err
    assert "would have been sent to" in recorded.out


def test_no_later_stage_takes_it_for_a_recording(recorded):
    manifest = manifest_of(recorded.folder)
    assert (manifest["status"], manifest["dry_run"], manifest["exit_code"]) == ("dry run", True, 0)
    code, _, err = call("identify", "pendulum", "--runs", recorded.runs)
    assert (code, "no finished 'record' of pipeline 'pendulum'" in err, "(1 dry run)" in err) == (1, True, True)
    for command in ("identify", "check"):
        code, _, err = call(command, "pendulum", "--log", recorded.folder / "session.mcap", "--runs", recorded.runs)
        assert code == 1
        assert "is of a dry run: torque was off, and none of its commands was sent" in err
    code, _, err = call("run", "pendulum", "--record.dry-run", "--runs", recorded.runs)
    assert (code, "a run cannot identify from it" in err) == (2, True)
    assert len(list(recorded.runs.glob("pendulum/*"))) == 1


def test_whoever_looks_at_the_run_is_told(recorded):
    run_dir = recorded.folder.parent
    assert "dry run" in call("info", run_dir)[1]
    assert "no command in it was sent" in call("info", recorded.folder / "session.mcap")[1]
    assert call("report", run_dir)[0] == 0
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    assert "Dry run: the robot did not move" in page
    assert "Commands to the motors, which were not sent" in page


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_in_order_too(tapped, tmp_path, number, code):
    tap, robot = tapped()

    def interrupt():
        end = time.monotonic() + 30.0
        while len(tap.packets) < 60 and time.monotonic() < end:
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt, daemon=True).start()
    command = on(tap.port, from_page("record.md"), "--duration-s", 60, "--runs", tmp_path)
    assert call(*command)[0] == code
    (folder,) = tmp_path.glob("pendulum/*/record")
    manifest = manifest_of(folder)
    assert (manifest["status"], manifest["dry_run"]) == ("interrupted", True)
    assert read_log(folder / "session.mcap").metadata["dry_run"] is True
    nothing_moved(tap, robot)


def test_a_deployment_says_what_the_policy_would_have_sent(tapped, tmp_path):
    tap, robot = tapped()
    bundle = steady(load_pipeline("pendulum").load(), tmp_path / "bundle")
    flags = ["--bundle", bundle, "--duration-s", 1, "--episodes", 1, "--runs", tmp_path]
    code, out, err = call(*on(tap.port, from_page("deploy.md"), *flags))
    assert code == 0, err
    nothing_moved(tap, robot)
    assert "the robot is not moved to its start" in err
    assert "the robot did not move, so there is no gap report" in err
    (folder,) = tmp_path.glob("pendulum/*/deploy")
    assert manifest_of(folder)["status"] == "dry run"
    result = json.loads((folder / "result.json").read_text())
    assert (result["dry_run"], result["gap"]) == (True, [])
    log = read_log(folder / "episode_0.mcap")
    sent = log.outputs["actuator"]["action"][:, 0]
    assert sent[-1] > 0.2
    (row,) = log.metadata["log"]["session_end"]["sent"]
    assert (row["name"], row["commands"], row["high"]) == ("hinge", len(sent), pytest.approx(float(sent.max())))
    assert "would have been sent to" in out
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Dry run: the robot did not move" in page
    assert "the deployment has no verdict" in page


def steady(robot, folder):
    """Write a bundle whose policy always asks for the same."""
    size = robot.agent.observation_size
    low, high = (np.array([getattr(a, side) for a in robot.agent.action], np.float32) for side in ("low", "high"))
    contract = PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz)
    zeros, n = np.zeros(size, np.float32), len(low)
    weights = {"mean": zeros, "std": zeros + 1, "low": low, "high": high, "log_std": np.zeros(n)}
    weights |= {"layers.0.kernel": np.zeros((size, n)), "layers.0.bias": np.full(n, 0.5)}
    return save_bundle(folder, weights, contract, np.zeros((1, size)))


@pytest.mark.night
def test_a_session_without_a_rig_of_a_device_is_refused(make_pipeline, tmp_path):
    name = make_pipeline(
        "no_dry_run",
        """
        class Rig:
            pass

        class Session:
            embedded = None
            rig = Rig()
            def __enter__(self):
                return self
            def __exit__(self, *exception):
                pass

        def connect(port, limits, truth_path, seed):
            return Session()
        """,
    )
    code, _, err = call("record", name, "--dry-run")
    assert code == 2
    assert "this robot's session has a Rig for a rig" in err
    assert "hint: make its `rig` a sim2real.hardware.safety.rig.Rig" in err
