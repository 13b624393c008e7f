"""How a person moves an SO-101 by hand, so that `sim2real new --like so101` can check its calibration."""

from __future__ import annotations

from pathlib import Path

from sim2real.hardware.calibration import Nudge

from .robot import SERVOS, TRAVEL_RAD, SO101Robot, calibrations, find, read

MIDDLE = "upper arm upright, forearm and hand level and forward, jaw half open"
"""The pose in which every joint is in the middle of its travel."""
_MOTIONS = (
    ("gripper", "open the jaw", 1),
    ("wrist_roll", "roll the hand to its left, anticlockwise as seen from the base", 1),
    ("wrist_flex", "bend the hand down", 1),
    ("elbow_flex", "lift the forearm", -1),
    ("shoulder_lift", "lean the upper arm back", -1),
    ("shoulder_pan", "turn the arm to its right, clockwise as seen from above", 1),
)
NUDGES = tuple(Nudge(joint, words, direction, TRAVEL_RAD.get(joint)) for joint, words, direction in _MOTIONS)
IDS, BAUD_RATE = SERVOS.ids, SERVOS.baud_rate


def robot(calibration: Path) -> SO101Robot:
    """Return an arm with a calibration of its own."""
    return SO101Robot(calibration=calibration)


def calibration_of(offsets: list[int]) -> Path:
    """Return LeRobot's calibration of the arm: of several files, that with the homing offsets of its servos.

    Raises:
        UsageError: There is none, or it is refused; see `read`.
    """
    paths = calibrations()[1]
    if len(paths) < 2:
        return find()
    return next((p for p in paths if [joint.homing_offset for joint in read(p)] == offsets), paths[0])
