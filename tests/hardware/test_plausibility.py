"""What cannot be true of a measurement stops the robot; what is normal does not."""

import contextlib

import numpy as np
import pytest

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import PositionDrive, VoltageDrive
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.plausibility import Plausibility
from sim2real.hardware.safety.rig import Rig

PERIOD_S = 0.02
CONFIG = GateConfig(max_speed_rad_s=(10.0, 2.0), joints=("pan", "tilt"))
STILL = np.array([0.5, -0.25])


def judge(efforts, positions=STILL, config=CONFIG):
    """Feed one row of efforts (N, 2) and positions a period; return the judge."""
    judge = Plausibility(config)
    efforts = np.asarray(efforts, float)
    for i, (effort, position) in enumerate(zip(efforts, np.broadcast_to(positions, efforts.shape), strict=True)):
        judge.check(position, i * PERIOD_S, 0.0, effort)
    return judge


def pushes(*rows):
    """Return efforts (N, 2) of the second joint from (effort, seconds)."""
    tilt = np.concatenate([np.full(round(s / PERIOD_S), e) for e, s in rows])
    return np.stack([np.zeros_like(tilt), tilt], axis=1)


@pytest.mark.parametrize(
    "efforts",
    [
        pushes((0.0, 5.0)),
        pushes((0.15, 2.0), (-0.15, 2.0)),  # sticks
        pushes((0.3, 5.0)),  # holds a weight
        pushes((0.6, 1.5)),  # a heavy one, for a while
        pushes((-0.3, 5.0), (0.3, 0.1)),  # has held, and has not answered yet
        np.where(np.arange(500)[:, None] // 4 % 2, [0.0, 0.5], [0.0, -0.5]),  # shivers at 6 Hz
    ],
    ids=["rest", "friction", "weight", "heavy weight", "latency", "shiver"],
)
def test_a_joint_that_stands_still_is_normal(efforts):
    assert judge(efforts).suspects == []


def moving_then_still(speed_rad_s, still=6):
    """Return positions (N, 2): the second joint moves, and then reads the same."""
    tilt = np.concatenate([speed_rad_s * PERIOD_S * np.arange(6), np.full(still, speed_rad_s * PERIOD_S * 5)])
    return np.stack([np.zeros_like(tilt), tilt], axis=1)


FREE = GateConfig(max_speed_rad_s=20.0, joints=("pan", "tilt"), freeze_rad_s=2.0)


def test_a_joint_that_stops_dead_though_it_is_pushed_is_stopped():
    path = moving_then_still(6.0)
    message = r"joint 'tilt' has read 0\.6 rad for 0\.06 s, but moved at 4 rad/s or more just before"
    with pytest.raises(SafetyStop, match=message):
        judge(np.full(path.shape, 0.1), path, FREE)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5, 0.99])
def test_an_encoder_that_freezes_at_any_moment_of_a_period_is_seen(share):
    """Of the last period before it froze it has seen this share, maybe but a count."""
    rotor = moving_then_still(9.0)
    rotor[6:, 1] += max(share * 9.0 * PERIOD_S, 0.0015)
    with pytest.raises(SafetyStop, match=r"but moved at [3-6].*rad/s or more just before"):
        judge(np.full(rotor.shape, 0.1), rotor, FREE)


@pytest.mark.parametrize(
    ("leap_rad", "period_s", "unsure_s", "stops"),
    [
        (0.09, 0.02, 0.0, True),  # 3 rad/s or more: 10 ms are what stamps may be off
        (0.09, 0.02, 0.02, False),  # 1.8: its answer came 20 ms late
        (0.18, 0.02, 0.02, True),
        (0.016, 0.004, 0.0, False),  # 4 rad/s by the stamps, but ten counts within 14 ms
    ],
)
def test_speeds_are_those_that_inexact_stamps_allow(leap_rad, period_s, unsure_s, stops):
    judge = Plausibility(FREE)
    judge.check(STILL, 1.0, 0.0, np.full(2, 0.1))
    with pytest.raises(SafetyStop, match="or more just before") if stops else contextlib.nullcontext():
        for k in range(40):
            unsure = unsure_s if k == 0 else 0.0
            judge.check(STILL + leap_rad, 1.0 + period_s * (k + 1), unsure, np.full(2, 0.1))
    if stops:
        assert period_s * k >= unsure_s + 0.05, "it may have moved until the late answer came"


@pytest.mark.parametrize(
    ("path", "effort"),
    [
        (moving_then_still(1.0), 0.1),  # a slow joint may stick
        (moving_then_still(6.0), 0.0),  # nothing pushes it: somebody moved it by hand
        (moving_then_still(6.0, still=2), 0.1),  # an old sample or two
        (np.cumsum(np.outer([0, *[3.5 * PERIOD_S] * 5, 0.01, 0, 0, 0, 0, 0], [0, 1]), axis=0), 0.1),  # it brakes
        (np.stack([np.zeros(40), 0.5 * np.sin(12.0 * PERIOD_S * np.arange(40))], axis=1), 0.1),  # it swings
    ],
    ids=["slow", "by hand", "old samples", "brakes", "swing"],
)
def test_what_comes_to_rest_by_itself_is_normal(path, effort):
    assert judge(np.full(path.shape, effort), path, FREE).suspects == []


def test_a_joint_that_is_pushed_both_ways_and_stands_still_is_stopped():
    message = r"joint 'tilt' has read -0.25 rad for 0\.\d+ s, though it was pushed both ways with more than 20%"
    with pytest.raises(SafetyStop, match=message):
        judge(pushes((0.25, 0.3), (-0.25, 0.3)))
    moving = np.stack([np.zeros(30), 0.001 * np.arange(30)], axis=1)
    assert judge(pushes((0.25, 0.3), (-0.25, 0.3)), moving).suspects == []
    patient = GateConfig(joints=("pan", "tilt"), stuck_effort=(0.2, 0.4))
    assert judge(pushes((0.3, 0.3), (-0.3, 0.3)), config=patient).suspects == []


def test_a_joint_that_is_pushed_otherwise_than_before_is_suspect_once():
    (said,) = judge(pushes((0.3, 1.0), (0.8, 2.0), (0.3, 1.0), (0.8, 1.0))).suspects
    assert said.startswith("joint 'tilt' has read -0.25 rad for 1.")
    assert said.endswith("though its push changed by 40% of its torque")
    (said,) = judge(pushes((0.5, 5.0))).suspects
    assert said == "joint 'tilt' has read -0.25 rad for 2.00 s, though it is pushed with 40% of its torque"


def test_a_leap_names_joint_value_and_limit():
    def leap(index, by_rad, after_s=PERIOD_S, unsure_s=0.0):
        judge = Plausibility(CONFIG)
        judge.check(STILL, 1.0, 0.0, np.zeros(2))
        position = STILL.copy()
        position[index] += by_rad
        judge.check(position, 1.0 + after_s, unsure_s, np.zeros(2))

    leap(0, 0.3)
    leap(1, 0.1)
    leap(1, 1.9, after_s=1.0)  # torque was off, and a hand was there
    leap(1, 0.15, unsure_s=0.05)  # a late answer
    message = (
        r"joint 'tilt' reads 0.05 rad, 0.3 rad from the last reading: at its fastest, 2 rad/s, it can have moved by "
    )
    with pytest.raises(SafetyStop, match=message + r"0\.11 rad"):
        leap(1, 0.3)


def test_limits_that_make_no_sense():
    for limits in ({"stuck_effort": 0.0}, {"stuck_s": -1.0}, {"max_speed_rad_s": (1.0, 0.0)}):
        with pytest.raises(UsageError, match="must be larger than 0"):
            GateConfig(**limits)


def swinging(freeze_s, hz, push, drive):
    """Return positions and efforts (N, 2) of a joint that swings, and whose encoder freezes."""
    t = PERIOD_S * np.arange(round((freeze_s + 4.0 / hz) / PERIOD_S))
    rotor = np.sin(2 * np.pi * hz * t)  # turns at 1/4, 3/4 ... of a period
    read = np.where(t < freeze_s, rotor, np.sin(2 * np.pi * hz * PERIOD_S * np.floor(freeze_s / PERIOD_S)))
    # A voltage goes on as planned; a position drive pushes the more, the farther the reading is from the goal.
    effort = push * np.sin(2 * np.pi * hz * t + 0.4) if drive == "volts" else np.clip(3.0 * (rotor - read), -push, push)
    return np.stack([np.zeros_like(t), read], axis=1), np.stack([np.zeros_like(t), effort], axis=1)


@pytest.mark.parametrize("drive", ["volts", "angles"])
@pytest.mark.parametrize("hz", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("turn", [0.25, 0.75, 1.25])
def test_an_encoder_that_freezes_at_a_turning_point_is_seen(turn, hz, drive):
    """There the joint stands still anyway, so that no speed tells of it; how it is pushed does."""
    freeze_s = turn / hz
    read, effort = swinging(freeze_s, hz, 0.5, drive)
    config = GateConfig(max_speed_rad_s=20.0, joints=("pan", "tilt"), freeze_rad_s=2.0)
    judge = Plausibility(config)
    said, i = "", 0
    try:
        for i, (position, push) in enumerate(zip(read, effort, strict=True)):
            judge.check(position, i * PERIOD_S, 0.0, push)
            if judge.suspects and drive == "angles":
                break
    except SafetyStop as stop:
        said = str(stop)
    assert i * PERIOD_S - freeze_s < 1.25 / hz, "within a period and a quarter"
    if drive == "volts":
        assert "though it was pushed both ways" in said
    else:  # from an extreme it is pushed one way alone, as a joint that lies on something: it may be right
        assert "though its push changed by" in judge.suspects[0]


@pytest.fixture
def open_rig(start_robot):
    rigs = []

    def open_(plant, drive, gate, config, ids):
        robot = start_robot(plant, config)
        bus = BusConfig(robot.port, silence_s=1.0)
        rigs.append(Rig(DynamixelServos(bus, ids, drive), gate))
        return rigs[-1]

    yield open_
    for rig in rigs:
        rig.close()


SERVOS = {
    "volts": ("FirstOrder", VoltageDrive(5.0), {"limit": 4.0}, (1,)),
    "angles": ("Joints", PositionDrive(800, 5.0), {"limit": 2.0, "stale": "hold"}, (1, 2, 3)),
}


def swing(rig, duration_s):
    """Push to and fro for a while, 0.3 s each way, as far as the drive lets a joint be pushed that does not follow."""
    rig.start()
    begin_s = 1e-9 * rig.clock.now_ns()
    while (t_s := 1e-9 * rig.clock.now_ns() - begin_s) < duration_s:
        sign = 1.0 if int(t_s / 0.3) % 2 else -1.0
        rig.measure()
        rig.command(np.full(len(rig.device.motors), sign * 1.9), 0.0, 1e-9 * rig.clock.now_ns())
        rig.clock.sleep(PERIOD_S)


@pytest.mark.parametrize("kind", SERVOS)
def test_an_encoder_that_stands_still_stops_the_robot(open_rig, kind):
    plant, drive, gate, ids = SERVOS[kind]
    gate = GateConfig(**gate, max_speed_rad_s=60.0, freeze_rad_s=1e3)  # it may move just then
    rig = open_rig(plant, drive, gate, EmulatorConfig(frozen_after_s=0.8), ids)
    with pytest.raises(SafetyStop, match=r"joint \d has read .* rad for .* s, though it was pushed both ways"):
        swing(rig, 5.0)


@pytest.mark.parametrize("kind", SERVOS)
def test_a_position_that_no_motor_reaches_stops_the_robot(open_rig, kind):
    plant, drive, gate, ids = SERVOS[kind]
    gate = GateConfig(**gate, max_speed_rad_s=60.0)
    rig = open_rig(plant, drive, gate, EmulatorConfig(wild=0.05, seed=2), ids)
    with pytest.raises(SafetyStop, match=r"joint \d reads \S+ rad, \S+ rad from the last reading"):
        swing(rig, 5.0)


@pytest.mark.parametrize("kind", SERVOS)
def test_joints_that_follow_are_not_suspect(open_rig, kind):
    plant, drive, gate, ids = SERVOS[kind]
    rig = open_rig(plant, drive, GateConfig(**gate, max_speed_rad_s=60.0), None, ids)
    swing(rig, 1.0)
    assert rig.suspects == []
    rig.stop()
