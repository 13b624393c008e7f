"""``record`` as a process of its own, on a robot that is one too: how it ends, and what it leaves."""

import contextlib
import io
import signal
import time
import warnings

import numpy as np
import pytest
from live_robots import PATIENT, assert_torque_ends_off, manifest_of, wait_until_running
from wiretap import Wiretap

from sim2real import cli, errors
from sim2real.artifacts.run.manifest import read_manifest
from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import Kind, read_truth
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.stages.pipeline.pipeline import load_pipeline

pytestmark = pytest.mark.process
LOG = "pendulum/*/record/session.mcap"


def test_ctrl_c_twice_ends_a_recording_in_order(tmp_path, start_cli):
    process = start_cli("record", "pendulum", "--duration-s", 20, "--runs", tmp_path, *PATIENT)
    log = wait_until_running(tmp_path, LOG, process)
    process.send_signal(signal.SIGINT)
    time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 130
    manifest = manifest_of(log.parent)
    assert (manifest["status"], manifest["exit_code"]) == ("interrupted", 130)
    assert "log" in manifest["outputs"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode = read_log(log)
    end = episode.metadata["log"]["session_end"]
    assert end["exit_code"] == 130
    assert end["timing"]["sensor"]["steps"] == len(episode.steps["sensor"])
    assert_torque_ends_off(read_truth(log.parent / "truth.bin"))


def test_a_killed_recording_leaves_all_but_a_quarter_of_a_second(tmp_path, lone_robot, start_cli):
    port, end_robot = lone_robot
    process = start_cli("record", "pendulum", "--port", port, "--duration-s", 20, "--runs", tmp_path, *PATIENT)
    log = wait_until_running(tmp_path, LOG, process)
    time.sleep(0.7)
    killed_ns = time.monotonic_ns()
    process.kill()
    process.wait()
    manifest = read_manifest(log.parent)
    assert manifest is not None
    assert manifest["status"] == "died"
    with pytest.warns(TruncatedLogWarning, match="has no end"):
        episode = read_log(log)
    to_monotonic_ns = time.monotonic_ns() - time.time_ns() + episode.metadata["log"]["epoch_ns"]
    for name, steps in episode.steps.items():
        assert (killed_ns - to_monotonic_ns - 1000 * int(steps.end[-1])) * 1e-9 < 0.25, name
    # Every command that reached the motor until then stands in the log.
    effects = end_robot().of(Kind.EFFECT)
    arrived_ns = effects["t_host_ns"][(effects["t_host_ns"] > 0) & (effects["values"][:, 1] != 0.0)]
    starts_ns, ends_ns = (
        to_monotonic_ns + 1000 * at for at in (episode.steps["actuator"].start, episode.steps["actuator"].end)
    )
    inside = arrived_ns[(arrived_ns >= starts_ns[0]) & (arrived_ns < killed_ns - 250_000_000)]
    assert len(inside) > 10
    step = np.searchsorted(starts_ns, inside, side="right") - 1
    assert np.all(inside <= ends_ns[step])


def test_an_unplugged_bus_ends_the_recording(tmp_path, lone_robot, start_cli):
    port, end_robot = lone_robot
    process = start_cli("record", "pendulum", "--port", port, "--duration-s", 20, "--runs", tmp_path, *PATIENT)
    log = wait_until_running(tmp_path, LOG, process)
    end_robot()  # with its end of the terminal
    said = process.communicate(timeout=20)[1]
    assert process.returncode == errors.HARDWARE_LOST
    assert "Traceback" not in said
    episode = read_log(log)
    assert episode.complete
    assert episode.metadata["log"]["session_end"]["exit_code"] == errors.HARDWARE_LOST
    assert manifest_of(log.parent)["exit_code"] == errors.HARDWARE_LOST


def test_strict_timing_ends_with_its_code_and_a_complete_log(make_pipeline, tmp_path):
    name = make_pipeline(
        "slow_agent",
        """
        class Slow(hardware.Excitation):
            def step(self, step_state):
                if step_state.seq % 10 == 9:
                    time.sleep(0.03)
                return super().step(step_state)

        def recording_nodes(session, signal):
            return nodes(session, signal, agent=Slow)
        """,
    )
    flags = ["--duration-s", "1", "--runs", str(tmp_path), *PATIENT, "--strict-timing"]
    assert cli.main(["record", name, *flags]) == errors.DEADLINE
    (folder,) = tmp_path.glob(f"{name}/*/record")
    episode = read_log(folder / "session.mcap")
    assert episode.complete
    assert episode.metadata["log"]["session_end"]["timing"]["agent"]["overruns"] >= 3
    assert (folder / "timing.json").is_file()
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def call(*arguments):
    """Run a command; return its exit code, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([str(a) for a in arguments])
    return code, out.getvalue(), err.getvalue()


def test_a_dry_run_sends_nothing_that_moves_and_is_no_recording(tmp_path):
    embedded = load_pipeline("pendulum").load().drive.embedded
    with EmbeddedRobot(embedded.plant, embedded.emulator, None, tmp_path / "truth.bin") as robot:
        tap = Wiretap(robot.port)
        flags = ["--duration-s", 1, "--amplitude", 2, "--gate.slew-per-s", 5, "--gate.servo-watchdog-s", 0.6]
        code, out, err = call("record", "pendulum", "--port", tap.port, "--dry-run", "--runs", tmp_path, *flags)
        tap.close()
        assert code == 0, err
        assert tap.motions() == []
        assert len(tap.packets) > 30
        assert tap.torque_offs() >= 2, "torque is switched off at both ends, as always"
        assert robot.truth().of(Kind.EFFECT).size == 0
    assert "would have been sent to" in out
    (folder,) = tmp_path.glob("pendulum/*/record")
    manifest = manifest_of(folder)
    assert (manifest["status"], manifest["dry_run"], manifest["exit_code"]) == ("dry run", True, 0)
    episode = read_log(folder / "session.mcap")
    assert episode.metadata["dry_run"] is True
    wanted, sent = (episode.outputs[n]["action"][:, 0] for n in ("agent", "actuator"))
    assert np.abs(wanted).max() > 1.0
    assert np.abs(sent).max() > 0.5
    (row,) = episode.metadata["log"]["session_end"]["sent"]
    np.testing.assert_allclose([row["low"], row["mean"], row["high"]], [sent.min(), sent.mean(), sent.max()], atol=1e-6)
    # No later stage takes it for a recording.
    assert call("identify", "pendulum", "--runs", tmp_path)[0] == errors.ERROR
    for command in ("identify", "check"):
        code, _, err = call(command, "pendulum", "--log", folder / "session.mcap", "--runs", tmp_path)
        assert code == errors.ERROR
        assert "dry run" in err
    assert "dry run" in call("info", folder.parent)[1]
    assert call("report", folder.parent)[0] == 0
    assert "Dry run" in (folder.parent / "report.html").read_text(encoding="utf-8")
