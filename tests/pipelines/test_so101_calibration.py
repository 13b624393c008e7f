"""A wrong calibration or assembly of an SO-101 is found before a motor moves."""

import json

import numpy as np
import pytest
import so101_person
from wrong_arms import RAD_PER_COUNT, WrongArm

from sim2real.commands.new import calibrate
from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, Sim2RealError
from sim2real.hardware.calibration import HandMotion
from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module, load_robot

SO101 = load_robot("so101")
GUIDE = load_module("so101", "guide")
GOOD = json.loads((SO101.folder / "calibration.json").read_text())


def written(folder, changes):
    """Write LeRobot's calibration of the arm with some changes; return its path."""
    path = folder / "lerobot.json"
    path.write_text(json.dumps({name: entry | changes.get(name, {}) for name, entry in GOOD.items()}))
    return path


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """Start an embedded arm with a person, and LeRobot's calibration of it; stopped at the end of the test."""
    arms = []

    def start(changes, emulation, **plant):
        hand = tmp_path / "hand.npz"
        so101_person.write_motion(hand, begin_s=6.0, speed_rad_s=4.0)
        monkeypatch.setenv("SO101_CALIBRATION", str(written(tmp_path, changes)))
        settings = {"homing_offset": 85, "plant_step_s": 0.001} | emulation
        truth = tmp_path / "truth.bin"
        arms.append(VirtualRobot(WrongArm(hand, **plant), StsEmulation(**settings), truth))
        return arms[-1]

    yield start
    for each in arms:
        each.stop()


def modes(arm):
    """Return the modes in which the arm's motors have been."""
    arm.stop()
    return set(arm.truth().of(Kind.EFFECT)["values"][:, 0].tolist())


RANGE = GOOD["shoulder_pan"]["range_min"], GOOD["shoulder_pan"]["range_max"]
FAULTS = {
    "missing servo": ({"missing": 5}, {}, {}, r"servo 5 does not answer .* Available: \[1, 2, 3, 4, 6\]"),
    "wrong baud rate": ({}, {}, {"baud_rate": 115_200}, "does not answer on .* at 1000000 baud"),
    "wrong model": ({}, {}, {"model_number": 1284}, "is model 1284"),
    "another arm's file": ({}, {}, {"homing_offset": -310}, "has homing offset -310, its calibration has 85"),
    "ids exchanged in the file": (
        {}, {"shoulder_lift": {"id": 3}, "elbow_flex": {"id": 2}}, {}, "'shoulder_lift' has id 3, not 2",
    ),
    "one id twice in the file": ({}, {"elbow_flex": {"id": 2}}, {}, "both have id 2"),
    "a seam in the range": ({}, {"elbow_flex": {"range_min": 0, "range_max": 4095}}, {}, "passed from count 4095"),
    "one stop was not reached": ({}, {"elbow_flex": {"range_max": 2100}}, {}, "not moved from stop to stop"),
    "servos exchanged": ({"exchanged": [2, 3]}, {}, {}, "elbow_flex was to be moved, but servo 2, shoulder_lift"),
    "a servo mounted turned": ({"turned": 4}, {}, {}, "wrist_flex turned in the other direction"),
    "a direction turned in the file": ({}, {"gripper": {"drive_mode": 1}}, {}, "gripper turned in the other direction"),
    "a zero that is off": (
        {}, {"shoulder_pan": {"range_min": RANGE[0] + 160, "range_max": RANGE[1] + 160}}, {},
        r"shoulder_pan turns at least \d+ degrees beyond",
    ),
    "a horn that has slipped": ({"slipped": 1}, {}, {}, r"shoulder_pan turns at least \d+ degrees beyond"),
    "a joint at its stop when calibrated": (
        {}, {"wrist_flex": {"range_min": 1842, "range_max": 3672}}, {},
        r"in the middle pose .*wrist_flex -\d+ degrees",
    ),
}  # fmt: skip


WHOLE_MOTION = {
    "servos exchanged", "a servo mounted turned", "a direction turned in the file", "a zero that is off",
    "a horn that has slipped", "a joint at its stop when calibrated",
}  # fmt: skip
"""Faults that a motion of the hand shows, on the counts of the encoders, without waiting for them."""


@pytest.mark.parametrize("fault", [f for f in FAULTS if f not in WHOLE_MOTION])
def test_a_fault_is_found_before_a_motor_moves(arm, tmp_path, fault):
    plant, changes, emulation, message = FAULTS[fault]
    wrong = arm(changes, emulation, **plant)
    with pytest.raises(Sim2RealError, match=f"(?s){message}"):
        calibrate(wrong.port, GUIDE, tmp_path / "calibration.json")
    assert modes(wrong) <= {OperatingMode.OFF}
    assert not (tmp_path / "calibration.json").exists()


PERIOD_S, PATIENCE_S, OFFSET = 0.02, 8.0, 85


def moved(folder, joints, **faults):
    """Show the whole motion of a person to a motion by hand; return whether it is complete."""
    end_s = so101_person.write_motion(folder / "hand.npz")
    arm, motion = WrongArm(folder / "hand.npz", **faults), HandMotion(joints, GUIDE.NUDGES)
    for t_s in np.arange(0.0, end_s + PATIENCE_S, PERIOD_S):
        arm.advance(t_s)
        angles = np.array([arm.measure(joint.servo_id)[0] for joint in joints])
        if motion.feed(t_s, (np.round(angles / RAD_PER_COUNT) - OFFSET) % 4096):
            return True
    return False


@pytest.mark.parametrize("fault", sorted(WHOLE_MOTION))
def test_a_fault_contradicts_the_motion(tmp_path, fault):
    plant, changes, _, message = FAULTS[fault]
    with pytest.raises(HardwareLost, match=f"(?s){message}"):
        moved(tmp_path, GUIDE.read(written(tmp_path, changes)), **plant)


def test_a_right_calibration_and_a_whole_motion_fit(tmp_path):
    assert moved(tmp_path, GUIDE.read(written(tmp_path, {})))
