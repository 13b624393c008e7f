"""Calibrations of SO-101 arms that other people recorded with LeRobot: which are read, and which are refused."""

import json
from pathlib import Path

import pytest

from sim2real.errors import UsageError
from sim2real.stages.pipeline.pipeline import load_pipeline

PIPELINE = load_pipeline("so101")
read = PIPELINE.load("robot").read
SEAM = "passed from count 4095 to count 0"


def changed(path: Path, motor: str, low: int, high: int) -> Path:
    """Write the embedded arm's calibration with another range of one motor."""
    motors = json.loads((PIPELINE.folder / "calibration.json").read_text())
    motors[motor].update(range_min=low, range_max=high)
    path.write_text(json.dumps(motors))
    return path


@pytest.mark.parametrize("motor", ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "gripper"])
@pytest.mark.parametrize(
    ("low", "high", "cause"),
    [
        (0, 4095, SEAM),
        (3, 4090, SEAM),
        (30, 4060, SEAM),
        (200, 3600, "another arm"),  # the joint came near to the seam only
        (2033, 2118, "not moved from stop to stop"),  # the range of a hand that held still
    ],
)
def test_a_range_that_is_no_travel_of_a_joint_with_stops_is_refused(tmp_path, motor, low, high, cause):
    with pytest.raises(UsageError, match=f"(?s){motor}.*from stop to stop.*{cause}.*calibrate again"):
        read(changed(tmp_path / "arm.json", motor, low, high))


@pytest.mark.parametrize(
    ("motor", "low", "high"),
    [
        ("shoulder_pan", 746, 3477),
        ("shoulder_pan", 1021, 3058),
        ("shoulder_lift", 775, 3266),
        ("elbow_flex", 901, 3110),
        ("wrist_flex", 652, 3222),
        ("wrist_roll", 0, 4095),
        ("wrist_roll", 135, 3984),
        ("wrist_roll", 1024, 3072),
        ("gripper", 1975, 3565),
        ("gripper", 2032, 3288),
    ],
)
def test_ranges_of_real_arms_are_read(tmp_path, motor, low, high):
    joint = next(j for j in read(changed(tmp_path / "arm.json", motor, low, high)) if j.name == motor)
    assert (joint.low_count, joint.high_count, joint.zero_count) == (low, high, (low + high) / 2)


def test_json_that_is_nested_100000_deep_is_refused(tmp_path):
    (tmp_path / "arm.json").write_text("[" * 100_000)
    with pytest.raises(UsageError, match="is not valid JSON"):
        read(tmp_path / "arm.json")
