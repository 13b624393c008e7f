"""Three position servos on one bus, through the rig, in virtual time."""

import math

import numpy as np
import pytest

from sim2real.emulation.dynamixel import EmulatedServo
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import PROTOCOL, DynamixelServos, PositionDrive, VoltageDrive
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

IDS = (1, 2, 3)
START_RAD = np.array([0.5, -0.8, 0.3])
DRIVE = PositionDrive(p_gain=800, profile_velocity_rad_s=20.0)
GATE = {"limit": 1.5, "stale": "hold", "command_timeout_s": 0.1, "first_step_rad": np.inf}
COUNT_RAD = reg.RAD_PER_COUNT


@pytest.fixture
def open_arm(start_robot):
    rigs = []

    def open_(drive=DRIVE, silence_s=1.0, robot=None, guardian=True, **gate):
        robot = robot or start_robot("Joints")
        bus = BusConfig(robot.port, silence_s=silence_s, guardian=guardian)
        rigs.append(Rig(DynamixelServos(bus, IDS, drive), GateConfig(**{**GATE, **gate})))
        return rigs[-1], robot

    yield open_
    for rig in rigs:
        rig.close()


def run(rig, goal, duration_s, period_s=0.02):
    """Command joint angles and read for a while; return what was sent and the last reading."""
    end = 1e-9 * rig.clock.now_ns() + duration_s
    sent = []
    while not sent or 1e-9 * rig.clock.now_ns() < end:
        sent.append(rig.command(np.asarray(goal), 0.0, 1e-9 * rig.clock.now_ns()))
        reading = rig.measure()
        rig.clock.sleep(period_s)
    return np.array(sent), reading


def effects(robot):
    """Goals that reached the motors: servo, mode, joint angle or share of PWM."""
    robot.stop()
    rows = robot.truth().of(Kind.EFFECT)
    modes, goals = rows["values"][:, 0], rows["values"][:, 1]
    return rows, modes, np.where(modes == OperatingMode.POSITION, goals - math.pi, goals)


def test_angles_count_from_the_joints_zero(open_arm):
    rig, robot = open_arm()
    assert rig.device.ids == IDS
    assert rig.measure().position_rad == pytest.approx(START_RAD, abs=COUNT_RAD)
    rig.close()
    rig, _ = open_arm(PositionDrive(800, 20.0, zero_count=(2048, 1000, 3000)), robot=robot, limit=(-1.5, 1.0))
    zeros = (np.array([2048, 1000, 3000]) - 2048) * COUNT_RAD
    assert rig.measure().position_rad == pytest.approx(START_RAD - zeros, abs=COUNT_RAD)
    rig.start()
    _, reading = run(rig, [0.1, 0.2, -0.3], 0.8)
    assert reading.position_rad == pytest.approx([0.1, 0.2, -0.3], abs=2 * COUNT_RAD)


def test_goals_arrive_together_and_the_joints_with_them(open_arm):
    rig, robot = open_arm()
    rig.start()
    _, reading = run(rig, [-0.4, 0.6, 1.0], 0.8)
    assert reading.position_rad == pytest.approx([-0.4, 0.6, 1.0], abs=2 * COUNT_RAD)
    rig.stop()
    rows, modes, _ = effects(robot)
    by_sync = rows[modes == OperatingMode.POSITION][3:]  # after one for each servo's torque
    assert np.all(by_sync["t_ns"].reshape(-1, 3) == by_sync["t_ns"][::3, None])
    assert modes[-3:].tolist() == [OperatingMode.OFF] * 3


def test_gains_and_profile_reach_servos_and_plant(open_arm):
    drive = PositionDrive(p_gain=1000, profile_velocity_rad_s=1.0, d_gain=7)
    rig, robot = open_arm(drive)
    registers = (reg.POSITION_P_GAIN, reg.POSITION_I_GAIN, reg.POSITION_D_GAIN, reg.PROFILE_ACCELERATION)
    assert [rig.device.link.read(2, register) for register in registers] == [1000, 0, 7, 0]
    assert rig.device.link.read(2, reg.OPERATING_MODE) == OperatingMode.POSITION
    rig.start()
    speeds = []
    for _ in range(15):
        _, reading = run(rig, [-0.5, -0.8, 1.3], 0.02)
        speeds.append(reading.velocity_rad_s)
    rig.close()
    robot.stop()
    _, states = robot.truth().states()
    assert [states[f"gain{i}"][-1] for i in IDS] == [1000.0] * 3
    assert [states[f"profile{i}"][-1] for i in IDS] == pytest.approx(
        [round(1.0 / reg.RAD_S_PER_COUNT) * 0.02398] * 3, rel=1e-3
    )
    assert np.abs(speeds).max() == pytest.approx(1.0, abs=0.05)


def test_a_rebooted_servo_gets_its_settings_again(open_arm):
    rig, _ = open_arm()
    with rig.device.link.hold():
        rig.device.link.port.write(PROTOCOL.build(3, Instruction.REBOOT))
    assert rig.device.link.read(3, reg.POSITION_P_GAIN) == 640
    rig.start()
    assert rig.device.link.read(3, reg.POSITION_P_GAIN) == 800


def test_a_setting_that_a_servo_does_not_keep_ends_it(open_arm, start_robot, monkeypatch):
    write = ServoLink.write

    def forgetful(self, servo_id, register, value):
        if (servo_id, register) != (2, reg.POSITION_P_GAIN):
            return write(self, servo_id, register, value)
        return None

    robot = start_robot("Joints")
    with monkeypatch.context() as patched:
        patched.setattr(ServoLink, "write", forgetful)
        with pytest.raises(HardwareLost, match=r"servo 2 .* position_p_gain is 640 after 800 was written"):
            open_arm(robot=robot)
    open_arm(robot=robot)  # the port is free again


def test_slew_starts_where_the_joints_are_also_outside_the_limits(open_arm):
    rig, _ = open_arm(slew_per_s=2.0, limit=([-1.0, -0.4, -1.0], 1.0))
    for goal in ([0.0, 0.0, 0.0], [1.0, -0.4, -1.0]):
        present = rig.measure().position_rad
        rig.start()
        sent, reading = run(rig, goal, 0.5)
        assert sent[0] == pytest.approx(present, abs=1.5 * COUNT_RAD)
        assert np.abs(np.diff(sent, axis=0)).max() <= 2.0 * 0.1
        assert np.abs(sent[-1] - sent[0]).max() > 0.5
        assert np.abs(reading.position_rad - sent[-1]).max() < 0.2
        rig.stop()


def test_a_tripped_servo_is_noticed_although_goals_are_not_confirmed(open_arm):
    rig, robot = open_arm(silence_s=0.1, guardian=False)
    rig.start()
    run(rig, [0.4, -0.7, 0.2], 0.3)
    robot.stall(0.25)
    tripped_s = 1e-9 * rig.clock.now_ns()
    rig.command(np.zeros(3), 0.0, tripped_s)  # nobody refuses
    with pytest.raises(SafetyStop, match="bus watchdog of servo 1 has tripped"):
        run(rig, [0.0, 0.0, 0.0], 3.0)
    assert 1e-9 * rig.clock.now_ns() - tripped_s < 0.8
    rig.stop()
    rig.start()
    run(rig, [0.4, -0.7, 0.2], 0.6)
    rig.stop()
    _, modes, _ = effects(robot)
    assert np.count_nonzero(modes == OperatingMode.PWM) == 3


def test_a_joint_outside_of_what_servos_take_keeps_its_torque_off(open_arm, start_robot):
    robot = start_robot("Joints", start_rad=[0.0, 3.3, 0.0])
    rig, _ = open_arm(robot=robot)
    with pytest.raises(SafetyStop, match=r"'servo 2' is at 3.3 rad, outside"):
        rig.start()
    assert rig.device.link.read(2, reg.TORQUE_ENABLE) == 0


def test_limits_beyond_the_servos_own_are_refused(open_arm, start_robot):
    robot = start_robot("Joints")
    with pytest.raises(UsageError, match=r"(?s)limit 3.2 exceeds the reach of the motors, .*-3.142.* to .*3.141"):
        open_arm(robot=robot, limit=3.2)
    robot.bus.servos[2].put(reg.MAX_POSITION_LIMIT, 3000)
    with pytest.raises(UsageError, match=r"to \[3.141, 1.461, 3.141\] rad"):
        open_arm(robot=robot)


@pytest.mark.parametrize(
    ("drive", "gate", "message"),
    [
        (DRIVE, {"stale": "zero"}, "stale = 'zero' is not safe with positions"),
        (VoltageDrive(5.0), {}, "stale = 'hold' is not safe with volts"),
        (PositionDrive(800, 1.0, zero_count=(1, 2)), {}, "2 zero counts for 3 servos"),
    ],
)
def test_gates_that_do_not_fit_are_refused_before_the_port_is_opened(drive, gate, message):
    with pytest.raises(UsageError, match=message):
        Rig(DynamixelServos(BusConfig("/dev/ttyNONE"), IDS, drive), GateConfig(**{**GATE, **gate}))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"p_gain": 20_000}, "position_p_gain = 20000 is outside"),
        ({"d_gain": -1}, "position_d_gain = -1 is outside"),
        ({"profile_velocity_rad_s": 0.0}, "profile_velocity_rad_s = 0.0 must be larger"),
        ({"profile_velocity_rad_s": float("nan")}, "profile_velocity_rad_s = nan must be larger"),
        ({"profile_velocity_rad_s": 1000.0}, "profile_velocity = .* is outside"),
        ({"zero_count": (2048, 4096)}, "zero_count"),
    ],
)
def test_drives_that_registers_cannot_hold(settings, message):
    with pytest.raises(UsageError, match=message):
        PositionDrive(**{"p_gain": 800, "profile_velocity_rad_s": 1.0, **settings})
    for supply_v in (0.0, -5.0, math.nan, math.inf):
        with pytest.raises(UsageError, match="supply_v"):
            VoltageDrive(supply_v)


@pytest.mark.parametrize(("found", "wanted"), [(0, 0), (1, 1), (4, 0), (13, 1)])
def test_profiles_are_by_speed_and_goals_switch_no_torque_on(open_arm, start_robot, monkeypatch, found, wanted):
    monkeypatch.setattr(EmulatedServo, "fixed", (reg.ID, reg.BAUD_RATE))
    robot = start_robot("Joints")
    robot.bus.servos[1].put(reg.DRIVE_MODE, found)
    open_arm(robot=robot)
    assert robot.bus.servos[1].get(reg.DRIVE_MODE) == wanted


@pytest.mark.parametrize(("speed_rad_s", "count"), [(math.inf, 0), (0.001, 1), (1.0, 42)])
def test_a_slow_profile_is_not_rounded_to_none(open_arm, speed_rad_s, count):
    rig, _ = open_arm(PositionDrive(800, speed_rad_s))
    assert rig.device.link.read(1, reg.PROFILE_VELOCITY) == count


def test_a_soft_stop_leaves_the_goals_where_they_are_until_all_is_still(open_arm):
    rig, _ = open_arm(stop_s=2.0, slew_per_s=3.0)
    rig.start()
    moving, _ = run(rig, START_RAD + 1.0, 0.3)  # on the way there
    rig.ease()
    assert not rig.eased, "it still moves"
    held, reading = run(rig, START_RAD + 1.0, 0.6)
    assert np.array_equal(held, np.broadcast_to(moving[-1], held.shape))
    assert rig.eased
    np.testing.assert_allclose(reading.position_rad, moving[-1], atol=0.02)
    assert rig.device.link.read(1, reg.TORQUE_ENABLE) == 1, "torque is somebody else's decision"
