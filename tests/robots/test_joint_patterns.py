"""Patterns for joints: usual ones match at once, and those that could take hours are refused."""

import time

import pytest

from sim2real.errors import UsageError
from sim2real.robots.from_model.joints.joint_patterns import require_quick
from sim2real.robots.from_model.mjcf_parameters import ParameterPattern

LONG = "a" * 60


@pytest.mark.parametrize(
    "pattern",
    [".*", ".*_hip_joint", "(left|right)_knee", "[FR][LR]_(hip|thigh)_joint", "a{2}b?", r"(a\+b)+", "j[*+]+"],
)  # fmt: skip
def test_usual_patterns_are_taken(pattern):
    ParameterPattern("kp", pattern)
    require_quick(pattern, [LONG])


@pytest.mark.parametrize(
    "pattern", ["(a+)+", "(a|a)*b", "((a)*)*b", "(a*b?)*c", "(?:a+){2,}c", "([a]+|b)*c", "((a|a))*d"]
)
def test_a_repeated_repetition_is_refused_at_once(pattern):
    begun_s = time.process_time()
    with pytest.raises(UsageError, match="can take hours"):
        ParameterPattern("kp", pattern)
    assert time.process_time() - begun_s < 5.0


def test_many_repetitions_are_refused_for_long_names():
    pattern = ".*" * 4 + "z"
    require_quick(pattern, ["FL_hip_joint"])
    with pytest.raises(UsageError, match="too many repetitions"):
        require_quick(pattern, ["j" * 5000])
