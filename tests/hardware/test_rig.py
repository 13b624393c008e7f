"""The rig, in virtual time: its commands, its limits and its episodes; test_ways_out.py has what stops it."""

from dataclasses import replace

import numpy as np
import pytest
from families import ANGLES, LEGS, VOLTS

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.device import OperatingMode


@pytest.fixture
def open_rig():
    """Open a rig on servos whose speed follows their voltage, 6 rad/s at 5 V, or of another family."""
    rigs = []

    def open_(family=VOLTS, **gate):
        robot = family.robot()
        rigs.append(family.rig(robot, {"command_timeout_s": 0.1, **gate}, silence_s=0.4))
        return rigs[-1], robot

    yield open_
    for rig in rigs:
        rig.close()


def volts(rig, value):
    return rig.command(np.full(3, value), 0.0, 1e-9 * rig.clock.now_ns())


def run(rig, value, duration_s, period_s=0.02):
    """Command a voltage and read for a while, like a control loop."""
    end = 1e-9 * rig.clock.now_ns() + duration_s
    while 1e-9 * rig.clock.now_ns() < end:
        volts(rig, value)
        rig.measure()
        rig.clock.sleep(period_s)


def effects(robot):
    robot.stop()
    return robot.truth().of(Kind.EFFECT)["values"][:, :2].T


def test_commands_are_volts_and_come_back_as_sent(open_rig):
    rig, _ = open_rig()
    rig.start()
    assert volts(rig, 2.5).tolist() == [2.5] * 3
    assert volts(rig, 9.0).tolist() == [4.0] * 3
    run(rig, 2.5, 0.4)
    reading = rig.measure()
    assert (reading.velocity_rad_s[0], reading.load[0]) == (pytest.approx(3.0, rel=0.1), pytest.approx(0.5, abs=0.002))
    rig.stop()
    assert rig.device.link.read(1, reg.TORQUE_ENABLE) == 0
    assert rig.gate.counts.clamped == 1
    assert rig.timeouts == 0


def test_a_rig_serves_several_episodes(open_rig):
    rig, robot = open_rig()
    for _ in range(3):
        rig.start()
        run(rig, 2.0, 0.15)
        rig.stop()
        rig.start()  # at once, before the watcher of the last one has woken
        assert rig.gate.counts.passed == 0
        run(rig, -2.0, 0.15)
        rig.stop()
    modes, goals = effects(robot)
    assert np.count_nonzero(np.diff((modes == OperatingMode.PWM).astype(int)) == 1) >= 5
    assert modes[-1] == OperatingMode.OFF
    assert goals.max() == pytest.approx(0.4, abs=0.01)
    assert goals.min() == pytest.approx(-0.4, abs=0.01)


def test_waiting_until_still(open_rig):
    rig, _ = open_rig()
    rig.start()
    run(rig, 3.0, 0.3)
    rig.stop()
    assert abs(rig.wait_until_still(5.0, for_s=0.1).velocity_rad_s[0]) < 0.05
    rig.start()
    run(rig, 3.0, 0.2)
    with pytest.raises(HardwareLost, match="still moves"):
        rig.wait_until_still(0.02)


def eased(rig, command, period_s):
    """Begin a soft stop; return what is sent until it is over, and how long it takes [s]."""
    rig.ease()
    begin_ns, sent = rig.clock.now_ns(), []
    while not rig.eased:
        sent.append(rig.command(command, 0.0, 1e-9 * rig.clock.now_ns()))
        rig.measure()
        rig.clock.sleep(period_s)
    return np.array(sent), 1e-9 * (rig.clock.now_ns() - begin_ns)


def test_a_soft_stop_fades_the_voltage_before_the_torque_goes_off(open_rig):
    rig, robot = open_rig(stop_s=0.5)
    rig.start()
    run(rig, 3.0, 0.3)
    sent, took_s = eased(rig, np.full(3, 3.0), 0.02)
    assert took_s < 0.5, "it is still before the longest time is over"
    assert np.all(np.diff(sent, axis=0) <= 0.0)
    assert len({*sent[:, 0]}) >= 5, "it fades, it does not drop"
    assert sent[-1, 0] == 0.0
    rig.stop()
    rig.start()  # the next episode is a full one again
    assert volts(rig, 3.0)[0] == 3.0
    assert not rig.eased
    rig.stop()
    assert effects(robot)[0, -1] == OperatingMode.OFF


@pytest.mark.skipif(LEGS is None, reason="the extra unitree")
def test_a_soft_stop_of_legs_fades_each_column_to_what_replaces_a_stale_one(open_rig):
    rig, _ = open_rig(LEGS, stop_s=0.4)
    rig.start()
    rig.command(LEGS.moving, 0.0, 1e-9 * rig.clock.now_ns())
    sent, took_s = eased(rig, LEGS.moving, 0.01)
    assert took_s < 0.5
    assert len({*sent[:, 0, 2]}) > 3
    assert np.all(np.diff(sent[:, :, 2], axis=0) <= 0.0)
    assert np.all(np.diff(sent[:, :, 3], axis=0) >= 0.0)
    np.testing.assert_allclose(sent[-1], rig.gate.config.at_rest(sent[-1]))


@pytest.mark.skipif(LEGS is None, reason="the extra unitree")
def test_a_sample_that_was_read_before_is_not_checked_again(open_rig, monkeypatch):
    rig, _ = open_rig(LEGS, max_sample_age_s=0.05)
    rig.start()
    raw = rig.device.measure()
    monkeypatch.setattr(rig.device, "measure", lambda: raw)
    assert rig.measure().transaction == raw.transaction
    raw = replace(raw, parts={**raw.parts, "quaternion": np.zeros(4)})
    assert rig.measure().transaction == raw.transaction
    # A device that repeats one sample for ever has stopped measuring.
    rig.clock.sleep(0.1)
    with pytest.raises(SafetyStop, match="newest measurement"):
        rig.require_fresh()
    raw = replace(raw, tick=raw.tick + 1)
    with pytest.raises(SafetyStop, match="'quaternion' of the reading has the norm 0"):
        rig.measure()


def test_in_a_dry_run_positions_start_where_the_joints_are_and_pass_the_gate(open_rig):
    rig, robot = open_rig(ANGLES, slew_per_s=2.0, first_step_rad=np.inf)
    rig.withhold_torque()
    rig.start()
    assert rig.gate.fallback == pytest.approx([0.5, -0.8, 0.3], abs=reg.RAD_PER_COUNT)
    rig.clock.sleep(0.6)  # the looks for servos that have lost their settings must find them as they should be
    rig.measure()
    sent = [rig.command(np.array([0.5, -3.0, 0.3]), 0.0, 0.02 * k) for k in range(20)]
    np.testing.assert_allclose(sent[-1], [0.5, -1.0, 0.3], atol=1e-2)
    assert (rig.gate.counts.passed, rig.gate.counts.clamped) == (20, 20)
    rig.stop()
    assert effects(robot).size == 0
    rig, _ = open_rig()
    rig.start()
    with pytest.raises(UsageError):  # the torque is on
        rig.withhold_torque()
