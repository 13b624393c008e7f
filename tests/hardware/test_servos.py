"""Servos of both families behind their driver, in virtual time: settings, ranges, what is refused and what is said."""

import math

import numpy as np
import pytest
from families import ANGLES, IDS, STS, VOLTS

from sim2real.emulation.dynamixel import EmulatedServo
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware import dynamixel as reg
from sim2real.hardware import feetech as sts
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import PositionDrive, VoltageDrive
from sim2real.hardware.bus.servos import ServoJoint as Joint
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import PROTOCOL, DynamixelServos
from sim2real.hardware.feetech import LEROBOT, StsServos
from sim2real.hardware.registry import load_device
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

START_RAD = np.array([0.5, -0.8, 0.3])
COUNT_RAD = reg.RAD_PER_COUNT
DRIVE = PositionDrive(800, 20.0)
GATE = {"limit": 1.5, "first_step_rad": np.inf, "slew_per_s": None, "stale": "hold"}
BOTH = pytest.mark.parametrize("family", [ANGLES, STS], ids=lambda family: family.name)


def angles(robot, drive=DRIVE, **limits):
    return DynamixelServos(BusConfig(robot.port, **{"silence_s": 1.0, **limits}), IDS, drive)


def feetech(robot, joints=IDS, drive=LEROBOT, **limits):
    return StsServos(BusConfig(robot.port, **{"silence_s": 1.0, **limits}), joints, drive)


@pytest.fixture
def rig_of():
    """Return what opens a rig on DYNAMIXELs by angle; closed at the end of the test."""
    rigs = []

    def open_(robot=None, drive=DRIVE, limits=None, **gate):
        robot = robot or ANGLES.robot()
        rigs.append(Rig(angles(robot, drive, **(limits or {})), GateConfig(**{**GATE, **gate})))
        return rigs[-1], robot

    yield open_
    for rig in rigs:
        rig.close()


def run(rig, goal, duration_s, period_s=0.02):
    """Command joint angles and read for a while; return what was sent and the last reading."""
    end, sent = 1e-9 * rig.clock.now_ns() + duration_s, []
    while not sent or 1e-9 * rig.clock.now_ns() < end:
        sent.append(rig.command(np.asarray(goal), 0.0, 1e-9 * rig.clock.now_ns()))
        reading = rig.measure()
        rig.clock.sleep(period_s)
    return np.array(sent), reading


def test_a_direction_and_a_zero():
    joints = [Joint("a", 1, direction=-1), Joint("b", 2), Joint("c", 3, zero_count=2148)]
    expected = np.array([-0.5, -0.8, 0.3 - 100 * COUNT_RAD])
    with feetech(STS.robot(), joints, PositionDrive(254)) as device:
        assert device.measure().position_rad == pytest.approx(expected, abs=COUNT_RAD)
        assert device.enable() == pytest.approx(expected, abs=COUNT_RAD)
        goal = expected + np.array([0.2, 0.1, -0.1])
        device.command(goal)
        device.clock.sleep(0.6)
        assert device.measure().position_rad == pytest.approx(goal, abs=0.02)


@pytest.mark.parametrize(
    ("family", "device", "expected"),
    [
        (ANGLES, lambda robot: angles(robot, PositionDrive(1000, 1.0, d_gain=7)),
         {reg.POSITION_P_GAIN: 1000, reg.POSITION_I_GAIN: 0, reg.POSITION_D_GAIN: 7, reg.PROFILE_ACCELERATION: 0,
          reg.PROFILE_VELOCITY: 42, reg.OPERATING_MODE: 3, reg.RETURN_DELAY_TIME: 0, reg.BUS_WATCHDOG: 50}),
        (ANGLES, lambda robot: angles(robot, PositionDrive(800, math.inf)), {reg.PROFILE_VELOCITY: 0}),
        (ANGLES, lambda robot: angles(robot, PositionDrive(800, 0.001)), {reg.PROFILE_VELOCITY: 1}),
        (VOLTS, lambda robot: angles(robot, VoltageDrive(5.0), silence_s=0.1),
         {reg.OPERATING_MODE: 16, reg.RETURN_DELAY_TIME: 0, reg.TORQUE_ENABLE: 1, reg.BUS_WATCHDOG: 5}),
        (STS, lambda robot: feetech(robot, drive=PositionDrive(20, 2.0, d_gain=5)),
         {sts.P_GAIN: 20, sts.D_GAIN: 5, sts.I_GAIN: 0, sts.GOAL_SPEED: 1304, sts.ACCELERATION: 0,
          sts.TORQUE_LIMIT: 1000, sts.RETURN_DELAY_TIME: 0, sts.LOCK: 1, sts.OPERATING_MODE: 0}),
    ],
)  # fmt: skip
def test_settings_reach_the_servos_and_those_that_were_lost_are_noticed(family, device, expected):
    robot = family.robot()
    with device(robot) as servos:
        servos.enable()
        for servo in robot.bus.servos.values():
            assert {register: servo.get(register) for register in expected} == expected
        servos.check()
        robot.bus.servos[2].put(family.torque, 0)  # by another program
        with pytest.raises(SafetyStop, match="servo 2 has lost its settings: torque_enable is 0, not 1"):
            servos.check()
        if family is STS:
            robot.bus.servos[2].reboot()
            assert robot.bus.servos[2].get(sts.RETURN_DELAY_TIME) == 250  # nothing was made permanent
            with pytest.raises(SafetyStop, match="servo 2 has lost its settings"):
                servos.check()
        servos.disable()
        assert family.on(robot) == []


def test_a_rebooted_servo_gets_its_settings_again(rig_of):
    rig, robot = rig_of()
    with rig.device.link.hold():
        robot.write(PROTOCOL.build(3, Instruction.REBOOT))
    assert rig.device.link.read(3, reg.POSITION_P_GAIN) == 640
    rig.start()
    assert rig.device.link.read(3, reg.POSITION_P_GAIN) == 800


@BOTH
def test_a_setting_that_a_servo_does_not_keep_ends_it(family):
    robot = family.robot()
    write = robot.bus.servos[2].write
    robot.bus.servos[2].write = lambda address, data: (0, False)
    with pytest.raises(HardwareLost, match=r"servo 2 does not keep its settings: \w+ is \d+ after \d+ was written"):
        family.device(robot).open()
    robot.bus.servos[2].write = write
    with family.device(robot):  # the port is free again
        pass


@pytest.mark.parametrize(("found", "wanted"), [(0, 0), (1, 1), (4, 0), (13, 1)])
def test_profiles_are_by_speed_and_goals_switch_no_torque_on(monkeypatch, found, wanted):
    monkeypatch.setattr(EmulatedServo, "fixed", (reg.ID, reg.BAUD_RATE))
    robot = ANGLES.robot()
    robot.bus.servos[1].put(reg.DRIVE_MODE, found)
    with angles(robot):
        assert robot.bus.servos[1].get(reg.DRIVE_MODE) == wanted


def test_speeds_of_servos_with_the_other_unit():
    robot = STS.robot("Ramp", speed_rad_s=1.0)
    robot.bus.servos[1].put(sts.PHASE, 0)
    with feetech(robot, (1,), PositionDrive(16, speed_rad_s=3.0)) as device:
        assert device.measure().velocity_rad_s == pytest.approx([1.0], abs=0.04)
        assert robot.bus.servos[1].get(sts.GOAL_SPEED) == 39  # of 0.732 rpm


def test_servos_that_answer_reads_only_are_told_to_answer_all():
    robot = STS.robot()
    for servo in robot.bus.servos.values():
        servo.put(sts.RESPONSE_LEVEL, 0)
        servo.put(sts.LOCK, 0)
    with feetech(robot) as device:
        device.enable()
        device.check()


def test_a_soft_stop_leaves_the_goals_where_they_are_until_all_is_still(rig_of):
    rig, robot = rig_of(stop_s=2.0, slew_per_s=3.0)
    rig.start()
    moving, _ = run(rig, START_RAD + 1.0, 0.3)  # on the way there
    rig.ease()
    assert not rig.eased, "it still moves"
    held, reading = run(rig, START_RAD + 1.0, 0.6)
    assert np.array_equal(held, np.broadcast_to(moving[-1], held.shape))
    assert rig.eased
    np.testing.assert_allclose(reading.position_rad, moving[-1], atol=0.02)
    assert ANGLES.on(robot) == list(IDS), "torque is somebody else's decision"


# What is refused


@pytest.mark.parametrize("angle", [math.nan, math.inf, 3.2, -0.6])
def test_goals_outside_the_range_are_refused(angle):
    joints = [Joint("pan", 1, low_count=1700, high_count=4000), Joint("lift", 2), Joint("elbow", 3)]
    with feetech(STS.robot(), joints) as device:
        low, high = device.reach()
        assert (low[0], high[0]) == pytest.approx((joints[0].angle(1700), joints[0].angle(4000)), abs=0.51 * COUNT_RAD)
        with pytest.raises(SafetyStop, match=r"joint 'pan': .* rad is outside"):
            device.command(np.array([angle, 0.0, 0.0]))
    volts = angle if math.isnan(angle) else 2.0 * angle + 4.0
    with VOLTS.device(VOLTS.robot()) as device:
        device.command(np.array([0.0, 5.0, -5.0]))
        if not abs(volts) <= 5.0:
            with pytest.raises(SafetyStop, match=r"'servo 2': .* V is outside \[-5"):
                device.command(np.array([0.0, volts, 0.0]))


@BOTH
def test_a_joint_outside_its_range_gets_no_torque(family):
    robot = family.robot(start_rad=[0.0, 3.3, 0.0])
    limits = (
        (reg.MIN_POSITION_LIMIT, reg.MAX_POSITION_LIMIT) if family is ANGLES else (sts.MIN_POSITION, sts.MAX_POSITION)
    )
    for register, count in zip(limits, (1000, 3000), strict=True):
        robot.bus.servos[2].put(register, count)
    with family.device(robot) as device, pytest.raises(SafetyStop, match=r"joint\W*.*2' is at .* rad, outside"):
        device.enable()
    assert family.on(robot) == []
    modes = robot.truth().of(Kind.EFFECT, 2)["values"][:, 0]
    assert np.all(modes == OperatingMode.OFF)


def test_limits_beyond_the_servos_own_are_refused(rig_of):
    robot = ANGLES.robot()
    with pytest.raises(UsageError, match=r"(?s)limit 3.2 exceeds the reach of the motors, .*-3.142.* to .*3.141"):
        rig_of(robot, limit=3.2)
    robot.bus.servos[2].put(reg.MAX_POSITION_LIMIT, 3000)
    with pytest.raises(UsageError, match=r"to \[3.141, 1.461, 3.141\] rad"):
        rig_of(robot)


def test_a_tripped_servo_is_noticed_although_goals_are_not_confirmed(rig_of):
    rig, robot = rig_of(limits={"silence_s": 0.1, "guardian": False})
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
    rows = robot.truth().of(Kind.EFFECT)
    assert np.count_nonzero(rows["values"][:, 0] == OperatingMode.PWM) == 3


def test_refusals_of_the_servo_are_explained():
    with angles(VOLTS.robot(), VoltageDrive(5.0)) as device:
        device.enable()
        with pytest.raises(Sim2RealError, match="servo 1 refused write of 3 to operating_mode: the register cannot"):
            device.link.write(1, reg.OPERATING_MODE, 3)


def test_a_missing_servo_is_named_with_those_that_answer():
    robot = ANGLES.robot()
    del robot.bus.servos[2]
    with pytest.raises(HardwareLost, match=r"servo 2.* does not answer .* Available: \[1, 3\]"):
        angles(robot).open()


@pytest.mark.parametrize(
    ("change", "joint", "said"),
    [
        ((sts.MODEL_NUMBER, 1284), Joint("pan", 1), r"servo 1 is model 1284.*Available: STS3215 \(777\)"),
        ((sts.HOMING_OFFSET, -7), Joint("pan", 1, homing_offset=5), "homing offset -7, its calibration has 5"),
        (
            (sts.MAX_POSITION, 3000),
            Joint("pan", 1, homing_offset=0),
            "accepts 0 to 3000 counts only, its joint needs 0 to 4095",
        ),
        ((sts.ID, 1), Joint("pan", 7), r"(?s)servo 7 \(joint 'pan'\) does not answer on .*: \[1, 2, 3\].*hint: "),
        ((sts.STATUS, 1), Joint("pan", 1), "servo 1 reports an alarm: input voltage"),
    ],
)
def test_servos_that_do_not_fit_their_joints(change, joint, said):
    robot = STS.robot()
    robot.bus.servos[1].put(*change)
    with pytest.raises((HardwareLost, SafetyStop), match=said):
        feetech(robot, [joint]).open()
    with feetech(robot, (2,)):  # nothing stays open, so the port is free
        pass


@pytest.mark.parametrize(
    ("kind", "config", "joints", "message"),
    [
        (DynamixelServos, {"baud_rate": 1234}, (1,), r"baud rate 1234\. Available: \[9600"),
        (DynamixelServos, {}, (1, 254), "from 0 to 253"),
        (DynamixelServos, {}, (), "at least one"),
        (StsServos, {"baud_rate": 2_000_000}, (1,), "baud rate"),
        (StsServos, {"silence_s": math.nan}, (1,), "silence_s"),
        (StsServos, {"max_silence_s": -1.0}, (1,), "max_silence_s"),
        (StsServos, {}, (Joint("a", 1), Joint("b", 1)), r"servos \[1, 1\]: .* another id"),
    ],
)
def test_configurations_that_make_no_sense(kind, config, joints, message):
    with pytest.raises(UsageError, match=message):
        kind(BusConfig("/dev/null", **config), joints, LEROBOT if kind is StsServos else VoltageDrive(5.0))


@pytest.mark.parametrize(
    ("kind", "drive", "message"),
    [
        (DynamixelServos, lambda: PositionDrive(20_000), "position_p_gain = 20000 is outside"),
        (DynamixelServos, lambda: PositionDrive(800, d_gain=-1), "position_d_gain = -1 is outside"),
        (DynamixelServos, lambda: PositionDrive(800, 0.0), "speed_rad_s = 0.0 must be larger"),
        (DynamixelServos, lambda: PositionDrive(800, 1000.0), "profile_velocity = .* is outside"),
        (DynamixelServos, lambda: VoltageDrive(math.nan), "supply_v"),
        (StsServos, lambda: PositionDrive(255), "p_gain = 255 is outside"),
        (StsServos, lambda: VoltageDrive(5.0), "Feetech servos take no volts"),
    ],
)
def test_drives_that_registers_cannot_hold(kind, drive, message):
    with pytest.raises(UsageError, match=message):
        kind(BusConfig("/dev/ttyNONE"), IDS, drive())


@pytest.mark.parametrize(
    ("drive", "gate", "message"),
    [
        (DRIVE, {"stale": "zero"}, "stale = 'zero' is not safe with positions"),
        (VoltageDrive(5.0), {}, "stale = 'hold' is not safe with volts"),
    ],
)
def test_gates_that_do_not_fit_are_refused_before_the_port_is_opened(drive, gate, message):
    with pytest.raises(UsageError, match=message):
        Rig(DynamixelServos(BusConfig("/dev/ttyNONE"), IDS, drive), GateConfig(**{**GATE, **gate}))


def test_ports_and_devices_that_are_not_open_or_open_already():
    device = StsServos(BusConfig("/dev/ttyNONE"), [Joint("a", 1)])
    with pytest.raises(HardwareLost, match=r"(?s)/dev/ttyNONE cannot be opened.*hint: serial ports here:"):
        device.open()
    with pytest.raises(HardwareLost, match="not open"):
        device.measure()
    robot = STS.robot()
    with feetech(robot) as device:
        with pytest.raises(UsageError, match="open already"):
            device.open()
        with pytest.raises(HardwareLost, match="cannot be opened"):
            feetech(robot).open()
        device.close()
        device.open()
        device.enable()


# What is said


def test_facts_for_a_log_are_those_of_the_registers():
    robot = STS.robot()
    for register, value in ((sts.FIRMWARE_MINOR, 9), (sts.PRESENT_VOLTAGE, 74), (sts.PRESENT_TEMPERATURE, 41)):
        robot.bus.servos[3].put(register, value)
    with feetech(robot, (3,)) as device:
        said = {"firmware": {"servo 3": "3.9"}, "voltage": {"servo 3": "7.4 V"}, "temperature": {"servo 3": "41 °C"}}
        assert device.facts() == said
    with angles(VOLTS.robot(), VoltageDrive(5.0)) as device:
        assert {kind: texts["servo 1"] for kind, texts in device.facts().items()} == {
            "firmware": "47",
            "voltage": "12.0 V",
            "temperature": "30 °C",
        }


def test_servos_by_the_devices_name():
    drive = PositionDrive(16, joints=(Joint("lift", 2, direction=-1), Joint("elbow", 3)))
    with load_device("feetech")(STS.robot().port, (1, 2), drive, baud_rate=1_000_000, silence_s=0.2) as device:
        assert device.silence_s == 0.2
        assert [joint.name for joint in device.joints] == ["servo 1", "lift"]
        assert device.measure().position_rad == pytest.approx([0.5, 0.8], abs=COUNT_RAD)


@pytest.mark.parametrize("held_up_s", [0.0, 0.02])
def test_a_lost_bus_names_the_computer_if_its_own_thread_did_not_run(monkeypatch, held_up_s):
    robot = VOLTS.robot(settings={"silent_after_s": 0.5})
    with angles(robot, VoltageDrive(5.0)) as device:
        robot.clock.sleep(0.6)
        read = robot.read

        def late(until_ns):
            data = read(until_ns)
            robot.stall(held_up_s)
            return data

        monkeypatch.setattr(robot, "read", late)
        with pytest.raises(HardwareLost) as lost:
            device.link.read(1, reg.PRESENT_POSITION)
    assert ("computer is too busy" in str(lost.value)) == (held_up_s > 0.0)
    assert ("cable" in str(lost.value)) == (held_up_s == 0.0)
