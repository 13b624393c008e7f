"""What cannot be true of a measurement stops the robot; what is normal does not."""

import contextlib

import numpy as np
import pytest

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.plausibility import Plausibility

PERIOD_S = 0.02
STILL = np.array([0.5, -0.25])
FREE = GateConfig(max_speed_rad_s=20.0, joints=("pan", "tilt"), freeze_rad_s=2.0)
PUSHED, FREED = np.ones(2, bool), np.zeros(2, bool)


def judge(positions, pushed=PUSHED):
    """Check one row of positions (N, 2) each period."""
    check = Plausibility(FREE)
    for i, position in enumerate(positions):
        check.check(position, i * PERIOD_S, 0.0, pushed)


def moving_then_still(speed_rad_s, still=6):
    """Return positions (N, 2): the second joint moves, and then reads the same."""
    tilt = np.concatenate([speed_rad_s * PERIOD_S * np.arange(6), np.full(still, speed_rad_s * PERIOD_S * 5)])
    return np.stack([np.zeros_like(tilt), tilt], axis=1)


def test_a_joint_that_stops_dead_though_it_is_pushed_is_stopped():
    with pytest.raises(SafetyStop, match=r"joint 'tilt' has read 0\.6 rad for 0\.06 s, but moved at 4 rad/s"):
        judge(moving_then_still(6.0))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5, 0.99])
def test_an_encoder_that_freezes_at_any_moment_of_a_period_is_seen(share):
    """Of the last period before it froze it has seen this share, maybe but a count."""
    rotor = moving_then_still(9.0)
    rotor[6:, 1] += max(share * 9.0 * PERIOD_S, 0.0015)
    with pytest.raises(SafetyStop, match=r"but moved at [3-6].*rad/s or more just before"):
        judge(rotor)


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
    judge.check(STILL, 1.0, 0.0, PUSHED)
    with pytest.raises(SafetyStop, match="or more just before") if stops else contextlib.nullcontext():
        for k in range(40):
            unsure = unsure_s if k == 0 else 0.0
            judge.check(STILL + leap_rad, 1.0 + period_s * (k + 1), unsure, PUSHED)
    if stops:
        assert period_s * k >= unsure_s + 0.05, "it may have moved until the late answer came"


@pytest.mark.parametrize(
    ("path", "pushed"),
    [
        (np.tile(STILL, (500, 1)), PUSHED),  # rests, sticks or holds a weight
        (moving_then_still(1.0), PUSHED),  # a slow joint may stick
        (moving_then_still(6.0), FREED),  # nothing pushes it: somebody moved it by hand
        (moving_then_still(6.0, still=2), PUSHED),  # an old sample or two
        (np.cumsum(np.outer([0, *[3.5 * PERIOD_S] * 5, 0.01, 0, 0, 0, 0, 0], [0, 1]), axis=0), PUSHED),  # it brakes
        (np.stack([np.zeros(40), 0.5 * np.sin(12.0 * PERIOD_S * np.arange(40))], axis=1), PUSHED),  # it swings
    ],
    ids=["still", "slow", "by hand", "old samples", "brakes", "swing"],
)
def test_what_comes_to_rest_by_itself_is_normal(path, pushed):
    judge(path, pushed)


def test_a_swinging_joint_that_a_host_finds_where_it_was_after_a_pause_is_not_frozen():
    check = Plausibility(FREE)
    for k in range(6):
        check.check(np.array([0.0, 0.1 * k]), k * PERIOD_S, 0.0, PUSHED)
    check.check(np.array([0.0, 0.5]), 5 * PERIOD_S + 0.14, 0.0, PUSHED)
    check.check(np.array([0.0, 0.4]), 6 * PERIOD_S + 0.14, 0.0, PUSHED)


@pytest.mark.parametrize(
    ("stale", "sent", "pushed"),
    [
        ("zero", [0.0, -0.1], [False, True]),
        ("hold", [0.0, -0.1], [True, True]),
        # Goal, gain and damping: without a gain the damping is what replaces a stale command.
        (("hold", "zero", 3.0), [[0.5, 0.0, 3.0], [0.5, 20.0, 3.0]], [False, True]),
    ],
)
def test_a_joint_is_pushed_by_a_command_that_is_not_the_one_of_rest(stale, sent, pushed):
    limit = ([-1.0, 0.0, 0.0], [1.0, 50.0, 5.0]) if isinstance(stale, tuple) else 1.0
    assert GateConfig(limit, stale=stale).pushes(np.array(sent)).tolist() == pushed


@pytest.mark.parametrize(
    ("index", "by_rad", "after_s", "unsure_s", "message"),
    [
        (0, 0.3, PERIOD_S, 0.0, ""),
        (1, 0.1, PERIOD_S, 0.0, ""),
        (1, 1.9, 1.0, 0.0, ""),  # torque was off, and a hand was there
        (1, 0.15, PERIOD_S, 0.05, ""),  # a late answer
        (1, 0.3, PERIOD_S, 0.0, r"joint 'tilt' reads 0.05 rad, 0.3 rad .* fastest, 2 rad/s, .* by 0\.11 rad"),
    ],
)
def test_a_leap_names_joint_value_and_limit(index, by_rad, after_s, unsure_s, message):
    check = Plausibility(GateConfig(max_speed_rad_s=(10.0, 2.0), joints=("pan", "tilt")))
    check.check(STILL, 1.0, 0.0, FREED)
    position = STILL.copy()
    position[index] += by_rad
    with pytest.raises(SafetyStop, match=message) if message else contextlib.nullcontext():
        check.check(position, 1.0 + after_s, unsure_s, FREED)


def test_a_joint_outside_of_its_envelope_is_named():
    check = Plausibility(GateConfig(envelope_rad=(-0.5, 0.5), joints=("pan", "tilt")))
    check.check(np.array([0.5, -0.5]), 0.0, 0.0, PUSHED)
    with pytest.raises(SafetyStop, match=r"joint 'tilt' is at -0\.51 rad, outside of its envelope, -0\.5 to 0\.5"):
        check.check(np.array([0.5, -0.51]), 0.02, 0.0, PUSHED)


def test_limits_that_make_no_sense():
    for limits in ({"freeze_s": 0.0}, {"freeze_rad_s": -1.0}, {"max_speed_rad_s": (1.0, 0.0)}):
        with pytest.raises(UsageError, match="must be larger than 0"):
            GateConfig(**limits)
