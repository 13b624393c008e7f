"""The rig, in virtual time: its commands, its limits and its episodes; test_ways_out.py has what stops it."""

import numpy as np
import pytest
from families import VOLTS

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.device import OperatingMode


@pytest.fixture
def open_rig():
    """Open a rig on servos whose speed follows their voltage: 6 rad/s at 5 V."""
    rigs = []

    def open_(**gate):
        robot = VOLTS.robot()
        rigs.append(VOLTS.rig(robot, {"command_timeout_s": 0.1, **gate}, silence_s=0.4))
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
    rows = robot.truth().of(Kind.EFFECT)
    return rows["t_ns"], rows["values"][:, 0], rows["values"][:, 1]


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
    _, modes, goals = effects(robot)
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


def test_a_soft_stop_fades_the_voltage_before_the_torque_goes_off(open_rig):
    rig, robot = open_rig(stop_s=0.5)
    rig.start()
    run(rig, 3.0, 0.3)
    rig.ease()
    begin = 1e-9 * rig.clock.now_ns()
    sent = []
    while not rig.eased:
        sent.append(volts(rig, 3.0)[0])
        rig.measure()
        rig.clock.sleep(0.02)
    assert 1e-9 * rig.clock.now_ns() - begin < 0.6
    assert sent == sorted(sent, reverse=True)
    assert len({*sent}) >= 5, "it fades, it does not drop"
    assert sent[-1] == 0.0
    rig.stop()
    rig.start()  # the next episode is a full one again
    assert volts(rig, 3.0)[0] == 3.0
    assert not rig.eased
    rig.stop()
    assert effects(robot)[1][-1] == OperatingMode.OFF
