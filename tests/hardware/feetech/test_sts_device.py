"""What the device does with servos that behave, and what it refuses."""

import math

import numpy as np
import pytest
from families import IDS

from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import ServoJoint as Joint
from sim2real.hardware.device import Alone, OperatingMode
from sim2real.hardware.feetech import StsDrive, StsServos
from sim2real.hardware.registry import load_device


def test_a_gear_a_direction_and_a_zero(serve, connect):
    joints = [Joint("a", 1, direction=-1), Joint("b", 2, gear=0.5), Joint("c", 3, zero_count=2148)]
    device = connect(serve(), joints=joints, drive=StsDrive(p_gain=254))
    expected = np.array([-0.5, -0.4, 0.3 - 100 * reg.RAD_PER_COUNT])
    assert device.measure().position_rad == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
    device.enable()
    assert device.rest() == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
    goal = expected + np.array([0.2, 0.1, -0.1])
    device.command(goal)
    device.clock.sleep(0.6)
    assert device.measure().position_rad == pytest.approx(goal, abs=0.02)


def test_facts_for_a_log_are_those_of_the_registers(serve, connect):
    robot = serve(ids=[4], start_rad=[0.0])
    for register, value in ((reg.FIRMWARE_MINOR, 9), (reg.PRESENT_VOLTAGE, 74), (reg.PRESENT_TEMPERATURE, 41)):
        robot.bus.servos[4].put(register, value)
    facts = connect(robot, ids=(4,)).facts()
    assert facts == {
        "firmware": {"servo 4": "3.9"},
        "voltage": {"servo 4": "7.4 V"},
        "temperature": {"servo 4": "41 °C"},
    }


def test_one_servo_confirms_its_goals(serve, connect):
    device = connect(serve(ids=[4], start_rad=[0.0]), ids=(4,))
    device.enable()
    assert device.command(np.array([0.01])).transfer_ns == 10_000 * (9 + 6)


def test_settings_are_read_back_and_nothing_is_made_permanent(serve, connect):
    robot = serve(config=StsEmulation(return_delay_us=500))
    drive = StsDrive(p_gain=20, d_gain=5, i_gain=1, speed_rad_s=2.0, acceleration_rad_s2=10.0, torque=0.5)
    device = connect(robot, drive=drive)
    device.enable()
    expected = {
        reg.P_GAIN: 20, reg.D_GAIN: 5, reg.I_GAIN: 1, reg.GOAL_SPEED: 1304, reg.ACCELERATION: 65, reg.TORQUE_LIMIT: 500,
        reg.RETURN_DELAY_TIME: 0, reg.LOCK: 1, reg.OPERATING_MODE: 0,
    }  # fmt: skip
    for servo_id in IDS:
        servo = robot.bus.servos[servo_id]
        assert {r: servo.get(r) for r in expected} == expected
        servo.reboot()
        assert servo.get(reg.RETURN_DELAY_TIME) == 250
    with pytest.raises(SafetyStop, match="servo 1 has lost its settings"):
        device.check()


def test_speeds_of_servos_with_the_other_unit(serve, connect):
    robot = serve("Ramp", ids=[1], speed_rad_s=1.0)
    robot.bus.servos[1].put(reg.PHASE, 0)
    device = connect(robot, ids=(1,), drive=StsDrive(speed_rad_s=3.0))
    assert device.measure().velocity_rad_s == pytest.approx([1.0], abs=0.04)
    assert robot.bus.servos[1].get(reg.GOAL_SPEED) == 39  # of 0.732 rpm


@pytest.mark.parametrize("angle", [math.nan, math.inf, 3.2, -0.6])
def test_goals_outside_the_range_are_refused(serve, connect, angle):
    joints = [
        Joint("pan", 1, low_count=1700, high_count=4000),
        Joint("lift", 2),
        Joint("elbow", 3),
    ]
    device = connect(serve(), joints=joints)
    low, high = device.reach()
    assert (low[0], high[0]) == pytest.approx(joints[0].range_rad, abs=0.51 * reg.RAD_PER_COUNT)
    with pytest.raises(SafetyStop, match=r"joint 'pan': .* rad is outside"):
        device.command(np.array([angle, 0.0, 0.0]))


def test_a_joint_outside_its_range_gets_no_torque(serve, connect):
    robot = serve()
    device = connect(
        robot,
        joints=[Joint("pan", 1, high_count=2100), Joint("lift", 2), Joint("elbow", 3)],
    )
    with pytest.raises(SafetyStop, match=r"joint 'pan' is at 0.5001 rad, outside \[-3.142, 0.07977\]"):
        device.enable()
    device.close()
    assert np.all(robot.truth().of(Kind.EFFECT)["values"][:, 0] == OperatingMode.OFF)


def test_what_they_do_without_a_host_is_said(serve, connect):
    (said,) = connect(serve()).without_host()
    assert (said.does, said.after_s, said.motors) == (Alone.GOES_ON, math.inf, ("servo 1", "servo 2", "servo 3"))
    assert str(said) == ("STS3215 (servo 1, servo 2, servo 3) goes on as commanded last (it has no bus watchdog)")
    assert "Memory Table" in said.source


@pytest.mark.parametrize(
    ("change", "joint", "said"),
    [
        ((reg.MODEL_NUMBER, 1284), Joint("pan", 1), r"servo 1 is model 1284.*Available: STS3215 \(777\)"),
        (
            (reg.HOMING_OFFSET, -7),
            Joint("pan", 1, homing_offset=5),
            "homing offset -7, its calibration has 5",
        ),
        (
            (reg.MAX_POSITION, 3000),
            Joint("pan", 1, homing_offset=0),
            "goes from 0 to 3000 counts only, its joint from 0 to 4095",
        ),
        (
            (reg.ID, 1),
            Joint("pan", 7),
            r"(?s)servo 7 \(joint 'pan'\) does not answer on .* at 1000000 baud.*: \[1, 2, 3\].*hint: ",
        ),
    ],
)
def test_servos_that_do_not_fit_their_joints(serve, connect, change, joint, said):
    robot = serve()
    robot.bus.servos[1].put(*change)
    with pytest.raises(HardwareLost, match=said):
        connect(robot, joints=[joint])
    connect(robot, ids=(2,))  # nothing stays open, so the port is free


def test_an_alarm_at_the_start_is_named(serve, connect):
    robot = serve()
    robot.bus.servos[3].put(reg.STATUS, 1)
    with pytest.raises(SafetyStop, match="servo 3 reports an alarm: input voltage"):
        connect(robot)


def test_a_setting_that_a_servo_does_not_keep(serve, connect):
    robot = serve()
    robot.bus.servos[2].write = lambda address, data: (0, False)
    with pytest.raises(HardwareLost, match="servo 2 does not keep its settings: p_gain is 32 after 16 was written"):
        connect(robot, joints=[Joint("pan", 1), Joint("lift", 2)])


def test_servos_that_answer_reads_only_are_told_to_answer_all(serve, connect):
    robot = serve()
    for servo in robot.bus.servos.values():
        servo.put(reg.RESPONSE_LEVEL, 0)
        servo.put(reg.LOCK, 0)
    device = connect(robot)
    device.enable()
    device.check()


def test_servos_by_the_devices_name(serve):
    servos = load_device("feetech")
    drive = StsDrive(joints=(Joint("lift", 2, direction=-1), Joint("elbow", 3)))
    with servos(serve().port, (1, 2), drive, baud_rate=1_000_000, silence_s=0.2) as device:
        assert device.silence_s == 0.2
        assert [joint.name for joint in device.joints] == ["servo 1", "lift"]
        assert device.measure().position_rad == pytest.approx([0.5, 0.8], abs=reg.RAD_PER_COUNT)


def test_usage_that_makes_no_sense(serve, connect):
    bus = BusConfig("/dev/ttyNONE")
    with pytest.raises(UsageError, match=r"servos \[1, 1\]: there must be at least one, each with an id of its own"):
        StsServos(bus, [Joint("a", 1), Joint("b", 1)])
    with pytest.raises(HardwareLost, match=r"(?s)/dev/ttyNONE cannot be opened.*hint: serial ports here:"):
        StsServos(bus, [Joint("a", 1)]).open()
    with pytest.raises(HardwareLost, match="not open"):
        StsServos(bus, [Joint("a", 1)]).measure()
    robot = serve()
    device = connect(robot)
    with pytest.raises(UsageError, match="open already"):
        device.open()
    with pytest.raises(HardwareLost, match="cannot be opened"):
        connect(robot)
    device.close()
    device.open()
    device.enable()


@pytest.mark.parametrize("bad", [{"p_gain": 255}, {"speed_rad_s": 0.0}, {"acceleration_rad_s2": -1.0}, {"torque": 1.5}])
def test_settings_that_make_no_sense(bad):
    with pytest.raises(UsageError, match=next(iter(bad))):
        StsDrive(**bad)


@pytest.mark.parametrize("bad", [{"baud_rate": 2_000_000}, {"silence_s": math.nan}, {"max_silence_s": -1.0}])
def test_limits_that_make_no_sense(bad):
    with pytest.raises(UsageError, match=next(iter(bad)).replace("_", "[_ ]")):
        StsServos(BusConfig("/dev/null", **bad), [1])
