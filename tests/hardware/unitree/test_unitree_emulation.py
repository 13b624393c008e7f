"""The emulated Go2 in planned time: its motors' law, its latencies, its noise, and what it does without its host."""

import numpy as np
import pytest

from pipelines.go2.plant import LYING, Go2Body
from sim2real.emulation.truth import Kind, TruthLog, read_truth
from sim2real.errors import UsageError

pytest.importorskip("cyclonedds")
from sim2real.emulation.legs import EmulatedLegs, UnitreeEmulation
from sim2real.emulation.robot import truth_header
from sim2real.hardware.unitree.messages import HEAD, LOW_LEVEL, NO_POSITION, NO_VELOCITY, LowCmd

MS = 1_000_000
NOISES = ("position_noise_rad", "velocity_noise_rad_s", "gyro_noise_rad_s", "tilt_noise_rad")
SILENT = dict.fromkeys((*NOISES, "accelerometer_noise_m_s2"), 0.0)


@pytest.fixture
def emulated(tmp_path):
    """Return what makes the motors of a body on a stand, without noise, and their truth log."""
    logs = []

    def make(body=None, **settings):
        body = body or Go2Body("stand")
        config = UnitreeEmulation(**{**SILENT, **settings})
        truth = TruthLog(tmp_path / "truth.bin", truth_header(body, config))
        logs.append(truth)
        return EmulatedLegs(body, config, truth), body, truth

    yield make
    for log in logs:
        log.close()


def command(q=0.0, dq=0.0, kp=0.0, kd=0.0, tau=0.0, mode=1):
    message = LowCmd()
    message.record["head"], message.record["level_flag"] = HEAD, LOW_LEVEL
    motors = message.record["motor_cmd"][:12]
    for name, value in {"q": q, "dq": dq, "kp": kp, "kd": kd, "tau": tau, "mode": mode}.items():
        motors[name] = value
    message.sign()
    return message


def test_the_torque_of_a_motor_is_that_of_its_law(emulated):
    legs, body, _ = emulated()
    law = {"q": np.array(LYING) + 0.1, "dq": 0.5, "kp": 20.0, "kd": 2.0, "tau": 0.7}
    legs.receive(command(**law), 0)
    legs.advance(20 * MS)
    before = body.measure()
    legs.advance(21 * MS)
    wanted = law["tau"] + law["kp"] * (law["q"] - before["q"]) + law["kd"] * (law["dq"] - before["dq"])
    np.testing.assert_allclose(body.measure()["tau_est"], wanted, atol=1e-4)
    np.testing.assert_allclose(legs.state(21 * MS).record["motor_state"]["tau_est"][:12], wanted, atol=1e-4)


def test_the_two_numbers_of_unitree_and_the_mode_take_controllers_out(emulated):
    for part in ({"q": NO_POSITION, "dq": NO_VELOCITY}, {"mode": 0, "q": 1.0}):
        legs, body, _ = emulated()
        legs.receive(command(**{"kp": 30.0, "kd": 2.0, "tau": 0.3, **part}), 0)
        legs.advance(5 * MS)
        np.testing.assert_allclose(body.measure()["tau_est"], 0.0 if "mode" in part else 0.3, atol=1e-6)


def test_commands_that_are_not_intact_are_ignored(emulated):
    legs, body, _ = emulated()
    wrong_crc, wrong_head = command(tau=1.0), command(tau=1.0)
    wrong_crc.record["motor_cmd"]["tau"][0] = 2.0
    wrong_head.record["head"] = (0, 0)
    wrong_head.sign()
    for message in (wrong_crc, wrong_head):
        legs.receive(message, 0)
    legs.advance(5 * MS)
    assert legs.ignored == 2
    assert not body.measure()["tau_est"].any()


def test_a_motor_is_as_strong_as_hidden_and_does_not_report_it():
    weak, usual = Go2Body("stand", seed=3), Go2Body("stand")
    law = np.zeros((12, 5))
    law[:, 4] = 2.0
    for body in (weak, usual):
        body.drive(law)
        body.step()
        np.testing.assert_allclose(body.measure()["tau_est"], 2.0)
    strength, zero = ([v for n, v in weak.truth().items() if n.endswith(what)] for what in ("_strength", "_zero"))
    np.testing.assert_allclose(weak.data.actuator_force, 2.0 * np.array(strength))
    np.testing.assert_allclose(weak.measure()["q"] - weak.data.qpos, zero)


def test_commands_act_and_states_age_by_their_latencies(emulated, tmp_path):
    legs, body, truth = emulated(sensing_latency_s=0.0035, actuation_latency_s=0.007)
    true_q, sent_q, torque = [body.measure()["q"][0]], [], [0.0]
    for ms in range(1, 60):
        legs.receive(command(q=np.array(LYING) + 0.2, kp=30.0, kd=1.0), ms * MS - MS // 2)
        legs.advance(ms * MS)
        true_q.append(body.measure()["q"][0])
        torque.append(body.measure()["tau_est"][0])
        sent_q.append(legs.state(ms * MS).record["motor_state"]["q"][0])
    assert not any(torque[:9])
    assert torque[9] > 1.0
    middle = (np.array(true_q[16:50]) + np.array(true_q[17:51])) / 2
    np.testing.assert_allclose(sent_q[19:53], middle, atol=1e-6)
    truth.close()
    effects = read_truth(tmp_path / "truth.bin").of(Kind.EFFECT)
    # From the grid point after its time on: half a step later, and the integrator is half a step early.
    np.testing.assert_array_equal(effects["t_ns"] - effects["t_host_ns"], 7 * MS)


def test_states_have_noise_of_the_size_that_the_settings_name(emulated):
    legs, _, _ = emulated(gyro_noise_rad_s=0.02, tilt_noise_rad=0.004, position_noise_rad=0.001)
    legs.advance(10 * MS)
    states = [legs.state(10 * MS) for _ in range(400)]
    assert all(state.intact for state in states)
    records = np.stack([state.record for state in states])
    imu = records["imu_state"]
    assert np.std(imu["gyroscope"], axis=0) == pytest.approx(0.02, rel=0.2)
    assert np.std(2 * imu["quaternion"][:, 1:], axis=0) == pytest.approx(0.004, rel=0.2)
    assert np.std(records["motor_state"]["q"][:, 0]) == pytest.approx(0.001, rel=0.2)
    np.testing.assert_allclose(imu["accelerometer"].mean(axis=0), [0.0, 0.0, 9.81], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(imu["quaternion"], axis=1), 1.0, atol=1e-5)


def test_on_the_floor_it_lies_at_rest_and_carries_its_weight():
    body = Go2Body("floor")
    state = body.state()
    assert 0.05 < state["base[2]"] < 0.09
    assert np.abs([state[f"velocity[{i}]"] for i in range(12)]).max() < 0.05
    np.testing.assert_allclose(np.linalg.norm(body.measure()["accelerometer"]), 9.81, rtol=0.02)


def test_settings_out_of_range_are_refused():
    with pytest.raises(UsageError, match=r"actuation_jitter_s = 0\.002"):
        UnitreeEmulation(actuation_latency_s=0.001, actuation_jitter_s=0.002)
    with pytest.raises(UsageError, match="tilt_noise_rad = -1"):
        UnitreeEmulation(tilt_noise_rad=-1)
