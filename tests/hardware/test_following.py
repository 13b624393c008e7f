"""A joint that does not do what its commands say stops the robot; tests/robots/test_following.py has whole robots."""

import math

import numpy as np
import pytest
from families import ANGLES, STS, VOLTS
from hypothesis import given
from hypothesis import strategies as st

from sim2real.errors import SafetyStop
from sim2real.hardware.device import Following
from sim2real.hardware.joint import Joint
from sim2real.hardware.safety.following import FollowingCheck
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

GATE = {"limit": 1.5, "slew_per_s": 20.0}
START = np.array([0.5, -0.8, 0.3])
LETS_GO = {"lets_go_after_s": 1.0, "lets_go": 2}


def swing(t_s):
    return START + 0.3 * np.sin(4.0 * t_s) * np.array([1.0, 1.0, 1.0])


def drive(rig, goals, seconds):
    """Command and measure at 50 Hz; return the time of the stop since the robot's start [s] and its message."""
    rig.start()
    begin_s = 1e-9 * rig.clock.now_ns()
    while (t_s := 1e-9 * rig.clock.now_ns() - begin_s) < seconds:
        try:
            rig.measure()
        except SafetyStop as error:
            return 1e-9 * rig.clock.now_ns(), str(error)
        rig.command(goals(t_s), 0.0, 1e-9 * rig.clock.now_ns())
        rig.clock.sleep(0.02)
    return None


def test_a_joint_at_rest_may_be_moved_off_its_goal_by_less_than_nearly_all_of_the_torque():
    robot = ANGLES.robot("Joints")
    with ANGLES.rig(robot) as rig:
        # 885 counts of PWM at a P gain of 800: 283 counts of error, 0.434 rad.
        assert float(rig.following.limit[0]) == pytest.approx(0.9 * 0.4344, abs=1e-4)
    geared = [Joint("pan", gear=2.0), Joint("lift"), Joint("tip")]
    with Rig(ANGLES.device(robot), GateConfig(**ANGLES.gate), geared) as rig:
        assert rig.following.limit[:2] == pytest.approx(0.9 * 0.4344 / np.array([2.0, 1.0]), abs=1e-4)
    robot.stop()


def test_what_is_not_watched_says_so():
    robot = VOLTS.robot()
    with VOLTS.rig(robot) as rig:
        assert rig.following is None
    robot = ANGLES.robot("Joints", LETS_GO)
    with ANGLES.rig(robot, {**GATE, "following_rad": math.inf}) as rig:
        assert rig.following is None
        assert drive(rig, swing, 3.0) is None


@given(
    delay=st.floats(0.0, 0.05),
    time_constant=st.floats(0.005, 0.05),
    weight=st.floats(-0.09, 0.09),
    goals=st.lists(st.floats(-1.5, 1.5), min_size=5, max_size=60),
)
def test_no_joint_of_first_order_is_stopped(delay, time_constant, weight, goals):
    """Steps of the goal of any size and at any rate, with a weight that the limit contains."""
    check = FollowingCheck(Following(0.1, 0.35, 0.5), np.zeros(1), 0.0, str)
    position, sent = 0.0, [(-1.0, 0.0)]
    for k in range(20 * len(goals)):
        t_s = 0.005 * k
        if k % 20 == 0:
            sent.append((t_s, goals[k // 20]))
            check.sending(np.array([goals[k // 20]]), t_s)
            check.sent(t_s)
        goal = next(value for since_s, value in reversed(sent) if since_s <= t_s - delay)
        position += (1.0 - math.exp(-0.005 / time_constant)) * (goal + weight - position)
        if k % 4 == 0:
            check.check(np.array([position]), np.zeros(1), np.zeros(1), t_s)


def let_go(check, still, since_s, until_s):
    for t_s in np.arange(since_s, until_s, 0.002):
        check.check(still, still, still, t_s)


def test_a_weak_motor_is_named_by_its_missing_torque():
    following = Following(8.0, 0.1, most_nm=np.array([23.7, 45.4]))
    law = np.array([[0.0, 0.0, 60.0, 2.0, 0.0], [0.5, 0.0, 60.0, 2.0, 1.0]])
    check = FollowingCheck(following, law, 0.0, lambda i: ("hip", "calf")[i])
    still, zero = np.zeros(2), np.zeros(2)
    for k in range(1, 50):  # the calf's law is 31 N m
        check.check(zero, still, np.array([0.0, 30.0]), 0.002 * k)
    with pytest.raises(SafetyStop, match=r"calf .* N m"):
        let_go(check, still, 0.1, 0.2)


def swung(lets_go_s=math.inf, limit=0.1, seed=0):
    """Play random pushes on a joint whose acceleration is known, 30 ms late, and measure it at uneven times.

    Returns:
        When it was stopped [s], or None.
    """
    rng, delay_s = np.random.default_rng(seed), 0.03
    push = lambda q, v, u: (-2.0 * v, 10.0 * u, np.full(1, 0.1))  # noqa: E731
    check = FollowingCheck(Following(limit, 0.35, push=push, delay_s=delay_s), np.zeros(1), 0.0, str)
    q, v, due_s, sent = 0.0, 0.0, 0.004, [(-1.0, 0.0)]
    for k in range(20_000):
        t_s = 1e-4 * k
        if k % 700 == 0:
            sent.append((t_s, rng.choice([-3.0, 3.0])))
            check.sending(np.array([sent[-1][1]]), t_s)
            check.sent(t_s)
        acting = [u for since_s, u in sent if since_s <= 1e-4 * k - delay_s][-1]
        if t_s >= due_s:
            due_s = t_s + rng.uniform(0.005, 0.02)
            try:
                check.check(np.array([q]), np.array([v]), np.zeros(1), t_s)
            except SafetyStop:
                return t_s
        v += 1e-4 * (10.0 * acting * (t_s < lets_go_s) - 2.0 * v)
        q += 1e-4 * v
    return None


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_lacks_its_push_is_stopped_and_one_that_has_it_is_not(seed):
    """A tenth of a push that is missing is seen, so times of commands and changes of speed are right."""
    assert swung(seed=seed) is None
    assert 1.0 < swung(1.0, 0.3, seed) < 1.5


def test_a_command_that_is_held_up_on_its_way_is_not_obeyed_yet():
    """A busy computer may stop a thread between its decision to send a goal and the port."""
    following = Following(0.1, 0.2, 2.0)
    check = FollowingCheck(following, np.zeros(1), 0.0, str)
    check.sending(np.full(1, 0.5), 0.1)
    for t_s in np.arange(0.1, 1.0, 0.02):
        check.check(np.zeros(1), np.zeros(1), np.zeros(1), t_s)
    check.sent(1.0)
    for t_s in np.arange(1.0, 1.19, 0.02):
        check.check(np.zeros(1), np.zeros(1), np.zeros(1), t_s)
    with pytest.raises(SafetyStop):
        let_go(check, np.zeros(1), 1.2, 1.5)


FIRST = START + np.array([0.0, 1.3, -1.2])


@pytest.mark.parametrize("family", [ANGLES, STS], ids=lambda family: family.name)
def test_each_sender_begins_near_the_measured_pose(family):
    robot = family.robot("Joints")
    with family.rig(robot, {**GATE, "joints": ("pan", "lift", "tip")}) as rig:
        rig.start()
        rig.measure()
        with pytest.raises(SafetyStop, match=r"'lift' at 0.5 rad, measured are -0.8"):
            rig.command(FIRST, 0.0, 0.0)
    with family.rig(robot, {**GATE, "first_step_rad": math.inf}) as rig:
        rig.start()
        rig.command(FIRST, 0.0, 0.0)
    robot.stop()
    robot = family.robot("Joints")
    with family.rig(robot, GATE) as rig:
        rig.start()
        rig.command(START + 0.4, 0.0, 0.0)
        rig.command(START - 0.6, 0.0, 0.02)  # the second command is the gate's to limit
        rig.command(START + 0.4, 0.0, 0.04)
        rig.measure()
        rig.hand_over()
        with pytest.raises(SafetyStop):  # it is near what was sent last
            rig.command(START + 0.7, 0.0, 0.06)
    robot.stop()
