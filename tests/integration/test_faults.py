"""What goes wrong while the robot moves: the exit code says it, the log is readable, the motor is off."""

import json
import time

import numpy as np
import pytest
from live_robots import assert_torque_ends_off, manifest_of, motor

from sim2real import cli, errors
from sim2real.hardware.emulation.truth import Kind, read_truth
from sim2real.hardware.plant import OperatingMode
from sim2real.log.reader import read_log

pytestmark = pytest.mark.process


@pytest.fixture
def record(tmp_path, capsys):
    """Record with a pipeline; return exit code, what was said, the stage's folder."""

    def call(name, *flags, duration_s=3):
        code = cli.main(["record", name, "--duration-s", str(duration_s), *flags])
        said = capsys.readouterr().err
        assert "Traceback" not in said
        (folder,) = (tmp_path / "runs" / name).glob("*/record")
        assert manifest_of(folder)["exit_code"] == code
        return code, said, folder

    return call


def test_a_servo_that_stops_answering(make_pipeline, record):
    name = make_pipeline(
        "silent_servo",
        """
        embedded = faulty_emulator(silent_after_s=4.0, model_number=1060)
        """,
    )
    code, said, folder = record(name, duration_s=10)
    assert code == errors.HARDWARE_LOST
    assert "no answer to" in said
    assert "node '" in said
    assert "hint: " in said
    episode = read_log(folder / "session.mcap")
    end = episode.metadata["log"]["session_end"]
    assert end["exit_code"] == errors.HARDWARE_LOST
    assert end["status"].startswith("HardwareLost")
    # Nothing that host or guardian say arrives any more: a servo that can has to stop by itself.
    truth = read_truth(folder / "truth.bin")
    t_ns, modes, goals = motor(truth)
    (trip,) = truth.of(Kind.WATCHDOG)
    assert 0.0 < (trip["t_ns"] - truth.header["start_ns"]) * 1e-9 - 4.0 < 0.15
    assert (modes[-1], goals[-1]) == (OperatingMode.PWM, 0.0)
    assert t_ns[-1] - trip["t_ns"] < 1e6
    assert np.any(goals != 0.0)


ILL = """
    embedded = faulty_emulator({fault})
    """


def test_an_encoder_that_stands_still_ends_the_recording(make_pipeline, record):
    name = make_pipeline("frozen_encoder", ILL.format(fault="frozen_after_s=2.0"))
    code, said, folder = record(name, "--excitation", "steps", duration_s=20)
    assert code == errors.SAFETY_STOP
    assert "joint 'hinge' has read " in said
    assert "though it was pushed both ways with more than 20% of its torque" in said
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_late_answers_are_told(make_pipeline, record):
    code, said, folder = record(make_pipeline("late_answers", ILL.format(fault="late=0.3")), duration_s=1)
    assert code == errors.OK
    assert "of the answers came late: when those samples were taken is not sure" in said
    assert json.loads((folder / "timing.json").read_text())["bus"]["late"] >= 10


@pytest.mark.parametrize("culprit", ["sensor", "agent"])
def test_a_nan_from_a_node(make_pipeline, record, culprit):
    base, field = {"sensor": ("ServoSensor", "th"), "agent": ("Excitation", "action")}[culprit]
    body = f"""
        class Broken(hardware.{base}):
            def step(self, step_state):
                step_state, message = super().step(step_state)
                factor = float("nan") if step_state.seq == 50 else 1.0
                return step_state, message.replace({field}=message.{field} * factor)

        def recording_nodes(session, signal):
            return nodes(session, signal, {culprit}=Broken)
        """
    name = make_pipeline(f"nan_{culprit}", body)
    code, said, folder = record(name)
    assert code == errors.SAFETY_STOP
    assert f"node '{culprit}'" in said or "node 'actuator'" in said
    assert "step 50" in said
    assert_torque_ends_off(read_truth(folder / "truth.bin"))
    episode = read_log(folder / "session.mcap")
    assert episode.metadata["log"]["session_end"]["exit_code"] == errors.SAFETY_STOP
    assert 50 <= len(episode.steps["sensor"]) <= 53
    if culprit == "sensor":
        assert np.isnan(episode.outputs["sensor"]["th"][50])


def test_an_exception_in_a_node(make_pipeline, record):
    name = make_pipeline(
        "raising_agent",
        """
        class Broken(hardware.Excitation):
            def step(self, step_state):
                if step_state.seq == 30:
                    raise KeyError("no such thing")
                return super().step(step_state)

        def recording_nodes(session, signal):
            return nodes(session, signal, agent=Broken)
        """,
    )
    code, said, folder = record(name)
    assert code == errors.ERROR
    assert "node 'agent' failed in its step 30: KeyError: 'no such thing'" in said
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


SLOW = """
    class Slow(hardware.Excitation):
        def step(self, step_state):
            if step_state.seq % 10 == 9:
                time.sleep(0.03)
            return super().step(step_state)

    def recording_nodes(session, signal):
        return nodes(session, signal, agent=Slow)
    """


def test_strict_timing_ends_with_its_code_and_a_complete_log(make_pipeline, record):
    code, said, folder = record(make_pipeline("slow_agent", SLOW), "--strict-timing")
    assert code == errors.DEADLINE
    assert "agent" in said
    assert "hint: " in said
    episode = read_log(folder / "session.mcap")
    assert episode.complete
    assert episode.duration_s > 2.9
    assert (folder / "timing.json").is_file()
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_late_nodes_are_only_told_without_strict_timing(make_pipeline, record):
    code, _, folder = record(make_pipeline("slow_agent_allowed", SLOW), duration_s=2)
    assert code == errors.OK
    assert read_log(folder / "session.mcap").metadata["log"]["session_end"]["timing"]["agent"]["overruns"] >= 5


def test_a_policy_that_hangs_gets_zero_volts(make_pipeline, record):
    name = make_pipeline(
        "hanging_agent",
        """
        class Hanging(hardware.Excitation):
            def step(self, step_state):
                if step_state.seq == 70:
                    time.sleep(0.5)
                return super().step(step_state)

        def recording_nodes(session, signal):
            return nodes(session, signal, agent=Hanging)
        """,
    )
    code, _, folder = record(name)
    assert code == errors.OK
    episode = read_log(folder / "session.mcap")
    end = episode.metadata["log"]["session_end"]
    assert end["command_timeouts"] >= 3
    ends = episode.steps["actuator"].end
    gap = int(np.argmax(np.diff(ends)))
    begin_ns, resumed_ns = (end["monotonic_ns"] + 1000 * int(ends[i]) for i in (gap, gap + 1))
    t_ns, _, goals = motor(read_truth(folder / "truth.bin"))
    # 0.1 s of patience, a fifth of that until the watcher looks, and up to 29 ms on the way to the motor.
    stopped = goals[(t_ns > begin_ns + 150e6) & (t_ns < resumed_ns)]
    assert stopped.size
    assert np.all(stopped == 0.0)


def test_a_step_that_hangs_ends_the_recording(make_pipeline, record):
    name = make_pipeline(
        "stuck_agent",
        """
        class Stuck(hardware.Excitation):
            def step(self, step_state):
                if step_state.seq == 40:
                    time.sleep(6)
                return super().step(step_state)

        def recording_nodes(session, signal):
            return nodes(session, signal, agent=Stuck)
        """,
    )
    begin = time.monotonic()
    code, said, folder = record(name, duration_s=50)
    assert code == errors.ERROR
    assert "node 'agent' hangs: its step 40 has taken 1 s" in said
    assert time.monotonic() - begin < 30.0
    assert len(read_log(folder / "session.mcap").steps["agent"]) == 40
    assert_torque_ends_off(read_truth(folder / "truth.bin"))


def test_a_slow_start_does_not_trip_the_servos_watchdog(make_pipeline, record):
    name = make_pipeline(
        "slow_start",
        """
        class Slow(hardware.Excitation):
            def startup(self, graph_state, timeout=None):
                time.sleep(1.0)
                return True

        def recording_nodes(session, signal):
            return nodes(session, signal, agent=Slow)
        """,
    )
    code, said, folder = record(name, duration_s=1)
    assert code == errors.OK, said
    truth = read_truth(folder / "truth.bin")
    assert not len(truth.of(Kind.WATCHDOG))
    assert_torque_ends_off(truth)
