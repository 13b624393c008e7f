"""A wrong calibration or assembly of an SO-101 is found before a motor moves."""

import json

import pytest
import so101_person
from wrong_arms import WrongArm

from sim2real.commands.new import calibrate
from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.truth import Kind
from sim2real.errors import Sim2RealError
from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module, load_robot

SO101 = load_robot("so101")
GUIDE = load_module("so101", "guide")
GOOD = json.loads((SO101.folder / "calibration.json").read_text())


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """Start an embedded arm with a person, and LeRobot's calibration of it; stopped at the end of the test."""
    arms = []

    def start(changes=None, emulation=None, **plant):
        hand, file = tmp_path / "hand.npz", tmp_path / "lerobot.json"
        so101_person.write_motion(hand, begin_s=6.0, speed_rad_s=4.0)
        file.write_text(json.dumps({name: entry | (changes or {}).get(name, {}) for name, entry in GOOD.items()}))
        monkeypatch.setenv("SO101_CALIBRATION", str(file))
        settings = {"homing_offset": 85, "plant_step_s": 0.001} | (emulation or {})
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
        r"in the middle pose .*: wrist_flex -\d+ degrees",
    ),
}  # fmt: skip


WHOLE_MOTION = {
    "servos exchanged", "a servo mounted turned", "a direction turned in the file", "a zero that is off",
    "a horn that has slipped", "a joint at its stop when calibrated",
}  # fmt: skip
"""Faults that a motion of the hand shows: in the gate in test_so101_hand_motion.py, where it takes no time."""


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=pytest.mark.night) if f in WHOLE_MOTION else f for f in FAULTS]
)
def test_a_fault_is_found_before_a_motor_moves(arm, tmp_path, fault):
    plant, changes, emulation, message = FAULTS[fault]
    wrong = arm(changes, emulation, **plant)
    with pytest.raises(Sim2RealError, match=f"(?s){message}"):
        calibrate(wrong.port, GUIDE, tmp_path / "calibration.json")
    assert modes(wrong) <= {OperatingMode.OFF}
    assert not (tmp_path / "calibration.json").exists()
