"""Torque withheld: the rig does all that it does, and the servos get neither torque nor a goal."""

import numpy as np
import pytest

from sim2real.emulation.truth import Kind
from sim2real.errors import SafetyStop
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import PositionDrive, VoltageDrive
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

START_RAD = np.array([0.5, -0.8, 0.3])


@pytest.fixture
def open_rig(start_robot):
    rigs = []

    def open_(drive, plant, ids, **gate):
        robot = start_robot(plant)
        bus = BusConfig(robot.port, silence_s=1.0)
        rigs.append(Rig(DynamixelServos(bus, ids, drive), GateConfig(command_timeout_s=0.1, **gate)))
        rigs[-1].withhold_torque()
        return rigs[-1], robot

    yield open_
    for rig in rigs:
        rig.close()


def assert_untouched(robot, register, bus, ids):
    """The servos' own goals are as at power-up, and their motors were told nothing."""
    for servo_id in ids:
        held = bus.link.read_each((servo_id,), register.address, register.size, "read")[0][0]
        assert register.decode(held) == register.default
        assert bus.read(servo_id, reg.TORQUE_ENABLE) == 0
    assert robot.truth().of(Kind.EFFECT).size == 0


def test_positions_start_where_the_joints_are_and_pass_the_gate(open_rig):
    drive = PositionDrive(p_gain=800, profile_velocity_rad_s=20.0)
    rig, robot = open_rig(drive, "Joints", (1, 2, 3), limit=1.0, slew_per_s=2.0, stale="hold")
    rig.start()
    assert rig.gate.fallback == pytest.approx(START_RAD, abs=reg.RAD_PER_COUNT)
    rig.clock.sleep(0.6)  # the looks for servos that have lost their settings must find them as they should be
    rig.measure()
    begin = 1e-9 * rig.clock.now_ns()
    sent = [rig.command(np.array([0.5, -3.0, 0.3]), 0.0, begin + 0.02 * k) for k in range(20)]
    rig.measure()
    np.testing.assert_allclose(sent[-1], [0.5, -1.0, 0.3], atol=1e-2)
    counts = rig.gate.counts
    assert (counts.passed, counts.clamped) == (20, 20)
    assert rig.device.counters.withheld >= 20 + 2 * 3
    rig.stop()
    assert_untouched(robot, reg.GOAL_POSITION, rig.device, (1, 2, 3))


def test_a_policy_that_hangs_gets_the_same_answer(open_rig):
    rig, robot = open_rig(VoltageDrive(5.0), "FirstOrder", (1,), limit=4.0)
    rig.start()
    rig.command(np.array([2.0]), 0.0, 1e-9 * rig.clock.now_ns())
    rig.clock.sleep(0.3)
    assert rig.timeouts >= 1
    rig.stop()
    assert_untouched(robot, reg.GOAL_PWM, rig.device, (1,))


def test_the_guardian_watches_as_well(start_robot, open_bus):
    """A process that is silent for too long is told so, as it would be with torque on."""
    robot = start_robot("FirstOrder")
    bus = open_bus(robot, silence_s=0.2)
    bus.setup(OperatingMode.PWM)
    bus.withhold_torque()
    bus.torque(True)
    assert bus.guardian_pid is not None
    robot.stall(0.6)
    with pytest.raises(SafetyStop, match="the guardian has taken the torque off"):
        bus.read_state()
    assert robot.truth().of(Kind.EFFECT).size == 0
