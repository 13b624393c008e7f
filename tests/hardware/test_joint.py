"""Angles of joints and of the encoders of their motors."""

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.hardware.joint import Joint

ENCODER_RAD = np.linspace(-3.0, 4.0, 29)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("gear", [1.0, 2.5, 0.4])
def test_there_and_back(direction, gear):
    joint = Joint("elbow", 0.7, direction, gear)
    angles = joint.angle(ENCODER_RAD)
    np.testing.assert_allclose(joint.encoder(angles), ENCODER_RAD, atol=1e-12)
    np.testing.assert_allclose(np.diff(angles), joint.speed(np.diff(ENCODER_RAD)), atol=1e-12)
    assert joint.angle(0.7) == 0.0
    assert np.all(np.sign(np.diff(angles)) == direction)
    assert np.ptp(angles) == pytest.approx(7.0 / gear)


def test_a_name_stands_for_a_joint_that_turns_with_its_encoder():
    assert Joint.of("hinge") == Joint("hinge", 0.0, 1, 1.0)
    assert Joint.of("hinge").is_plain
    geared = Joint("hinge", gear=2.0)
    assert Joint.of(geared) is geared
    assert not any(joint.is_plain for joint in (geared, Joint("a", 0.1), Joint("a", direction=-1)))


def test_a_joint_on_its_motor_changes_no_bit():
    assert np.array_equal(Joint("hinge").angle(ENCODER_RAD), ENCODER_RAD)
    assert np.array_equal(Joint("hinge").speed(ENCODER_RAD), ENCODER_RAD)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"direction": 0}, "neither 1 nor -1"), ({"gear": -2.0}, "not a number above 0"), ({"gear": 0.0}, "above 0"),
     ({"zero_rad": float("nan")}, "not a finite angle")],
)  # fmt: skip
def test_what_cannot_be_converted_is_refused(wrong, said):
    with pytest.raises(UsageError, match=f"joint 'elbow'.*{said}"):
        Joint("elbow", **wrong)
