"""What cannot be true of a measurement stops the robot; what is normal does not."""

import contextlib
import math

import numpy as np
import pytest

from sim2real.errors import SafetyStop
from sim2real.hardware.device import ReadingPart
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.plausibility import Plausibility, require_parts

PERIOD_S = 0.02
STILL = np.array([0.5, -0.25])
FREE = GateConfig(max_speed_rad_s=20.0, joints=("pan", "tilt"), freeze_rad_s=2.0)
PUSHED, FREED = np.ones(2, bool), np.zeros(2, bool)


def judge(positions, pushed=PUSHED, pause_s=0.0):
    """Check one row of positions (N, 2) each period, the last two after a pause of the host."""
    check = Plausibility(FREE)
    for i, position in enumerate(positions):
        check.check(position, i * PERIOD_S + pause_s * (i >= len(positions) - 2), 0.0, pushed)


def moving_then_still(speed_rad_s, still=6):
    """Return positions (N, 2): the second joint moves, and then reads the same."""
    tilt = np.concatenate([speed_rad_s * PERIOD_S * np.arange(6), np.full(still, speed_rad_s * PERIOD_S * 5)])
    return np.stack([np.zeros_like(tilt), tilt], axis=1)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5, 0.99])
def test_an_encoder_that_freezes_at_any_moment_of_a_period_is_seen(share):
    """Of the last period before it froze it has seen this share, maybe but a count."""
    rotor = moving_then_still(9.0)
    rotor[6:, 1] += max(share * 9.0 * PERIOD_S, 0.0015)
    with pytest.raises(SafetyStop, match=r"joint 'tilt' has read .* for 0\.06 s, but moved at [3-6].*rad/s or more"):
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
    ("path", "pushed", "pause_s"),
    [
        (np.tile(STILL, (500, 1)), PUSHED, 0.0),  # rests, sticks or holds a weight
        (moving_then_still(1.0), PUSHED, 0.0),  # a slow joint may stick
        (moving_then_still(6.0), FREED, 0.0),  # nothing pushes it: somebody moved it by hand
        (moving_then_still(6.0, still=2), PUSHED, 0.0),  # an old sample or two
        (np.cumsum(np.outer([0, *[3.5 * PERIOD_S] * 5, 0.01, 0, 0, 0, 0, 0], [0, 1]), axis=0), PUSHED, 0.0),  # brakes
        (np.stack([np.zeros(40), 0.5 * np.sin(12.0 * PERIOD_S * np.arange(40))], axis=1), PUSHED, 0.0),  # it swings
        (np.outer([0, 1, 2, 3, 4, 5, 5, 4], [0.0, 0.1]), PUSHED, 0.12),  # and is found where it was before
    ],
    ids=["still", "slow", "by hand", "old samples", "brakes", "swing", "after a pause"],
)
def test_what_comes_to_rest_by_itself_is_normal(path, pushed, pause_s):
    judge(path, pushed, pause_s)


@pytest.mark.parametrize(
    ("by_rad", "after_s", "unsure_s", "message"),
    [
        ([0.3, 0.1], PERIOD_S, 0.0, ""),
        ([0.0, 1.9], 1.0, 0.0, ""),  # torque was off, and a hand was there
        ([0.0, 0.15], PERIOD_S, 0.05, ""),  # a late answer
        ([0.3, 0.3], PERIOD_S, 0.0, r"joint 'tilt' reads 0.05 rad, 0.3 rad .* fastest, 2 rad/s, .* by 0\.11 rad"),
    ],
)
def test_a_leap_names_joint_value_and_limit(by_rad, after_s, unsure_s, message):
    check = Plausibility(GateConfig(max_speed_rad_s=(10.0, 2.0), joints=("pan", "tilt")))
    check.check(STILL, 1.0, 0.0, FREED)
    with pytest.raises(SafetyStop, match=message) if message else contextlib.nullcontext():
        check.check(STILL + by_rad, 1.0 + after_s, unsure_s, FREED)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_joint_outside_of_its_envelope_is_named_and_one_that_is_no_number_hides_no_other(bad):
    limits = GateConfig(envelope_rad=(-0.5, 0.5), max_speed_rad_s=1.0, joints=("pan", "tilt"))
    check = Plausibility(limits)
    check.check(np.array([0.5, -0.5]), 0.0, 0.0, PUSHED)
    with pytest.raises(SafetyStop, match=r"joint 'tilt' is at -0\.51 rad, outside of its envelope, -0\.5 to 0\.5"):
        check.check(np.array([0.5, -0.51]), 0.02, 0.0, PUSHED)
    with pytest.raises(SafetyStop, match="pan|tilt" if np.isinf(bad) else "'tilt'.*envelope"):
        Plausibility(limits).check(np.array([bad, 5.0]), 0.0, 0.0, FREED)
    check = Plausibility(GateConfig(max_speed_rad_s=1.0))
    check.check(np.zeros(2), 0.0, 0.0, FREED)
    with pytest.raises(SafetyStop):
        check.check(np.array([0.0, bad]), 0.01, 0.0, FREED)


PARTS = {
    "quaternion": ReadingPart("1", (4,), norm=(0.99, 1.01)),
    "foot_force": ReadingPart("N", (2,), low=0.0, high=500.0),
}
GOOD = {"quaternion": np.array([1.0, 0, 0, 0]), "foot_force": np.array([0.0, 500.0])}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"quaternion": np.array([2.0, 0, 0, 0])}, "norm 2, not 0.99 to 1.01"),
        ({"quaternion": np.zeros(3)}, r"has the shape \(3,\)"),
        ({"foot_force": np.array([-1.0, 0.0])}, "not 0 to 500"),
        ({"foot_force": np.array([0.0, 501.0])}, "not 0 to 500"),
        ({"foot_force": np.array([math.nan, 0.0])}, "not 0 to 500"),
        ({"foot_force": None}, "'foot_force' of the reading is missing"),
    ],
)
def test_a_part_that_is_not_possible_stops_the_robot(changed, words):
    require_parts(GOOD, PARTS)
    with pytest.raises(SafetyStop, match=words):
        require_parts({name: value for name, value in {**GOOD, **changed}.items() if value is not None}, PARTS)
