import json
import math

import pytest

from sim2real.errors import UsageError
from sim2real.hardware.bus.servos import ServoJoint as Joint
from sim2real.hardware.calibration import read_calibration

FOLLOWER = """{
    "shoulder_pan": {
        "id": 1,
        "drive_mode": 0,
        "homing_offset": -1365,
        "range_min": 746,
        "range_max": 3477
    },
    "wrist_roll": {
        "id": 5,
        "drive_mode": 0,
        "homing_offset": 1761,
        "range_min": 0,
        "range_max": 4095
    },
    "gripper": {
        "id": 6,
        "drive_mode": 1,
        "homing_offset": 0,
        "range_min": 2030,
        "range_max": 3495
    }
}"""


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "arm.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return path

    return write


def test_a_file_of_lerobots(written):
    pan, roll, gripper = read_calibration(written(FOLLOWER))
    assert pan == Joint("shoulder_pan", 1, 2111.5, 1, 746, 3477, homing_offset=-1365)
    # LeRobot's degrees: (count - middle) * 360 / 4095; ours are 0.02 % smaller.
    assert math.degrees(pan.angle(3000)) == pytest.approx((3000 - (746 + 3477) / 2) * 360 / 4095, rel=3e-4)
    assert pan.angle(746) == pytest.approx(-pan.angle(3477))
    assert (roll.low_count, roll.high_count, roll.homing_offset) == (0, 4095, 1761)
    assert gripper.direction == -1
    assert gripper.angle(2030) > 0.0 > gripper.angle(3495)


def entry(**changes):
    whole = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 100, "range_max": 4000} | changes
    return {"elbow": {key: value for key, value in whole.items() if value is not None}}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "Input data was truncated"),
        ([1], "Expected `object`, got `array`"),
        ({}, "holds no motors"),
        (entry(homing_offset=None), "Object missing required field `homing_offset`"),
        (entry(gear=2), "unknown field `gear`"),
        (entry(drive_mode=True), "Expected `int`, got `bool` - at `$[...].drive_mode`"),
        (entry(range_max=4096), "Expected `int` <= 4095 - at `$[...].range_max`"),
        (entry(range_min=4000), "range_min = 4000 is not below range_max = 4000"),
        (entry() | {"wrist": entry()["elbow"]}, "motors 'elbow' and 'wrist' both have id 1"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(written, content, said):
    with pytest.raises(UsageError) as raised:
        read_calibration(written(content))
    assert said in str(raised.value)
    with pytest.raises(UsageError, match=r"(?s)none.json cannot be read.*lerobot-calibrate"):
        read_calibration(written(content).with_name("none.json"))


@pytest.mark.parametrize("bad", [{"direction": 0}, {"low_count": 9, "high_count": 9}])
def test_joints_that_make_no_sense(bad):
    with pytest.raises(UsageError, match="joint 'elbow'"):
        Joint("elbow", 1, **bad)
