"""The motion that checks an SO-101's calibration, on the counts of its encoders, without waiting for them."""

import json

import numpy as np
import pytest
import so101_person
from test_so101_calibration import FAULTS, GOOD, GUIDE, WHOLE_MOTION
from wrong_arms import RAD_PER_COUNT, WrongArm

from sim2real.errors import HardwareLost
from sim2real.hardware.calibration import HandMotion

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


def calibration(folder, changes):
    """Return the joints of LeRobot's calibration with some changes."""
    path = folder / "lerobot.json"
    path.write_text(json.dumps({name: entry | changes.get(name, {}) for name, entry in GOOD.items()}))
    return GUIDE.read(path)


@pytest.mark.parametrize("fault", sorted(WHOLE_MOTION))
def test_a_fault_contradicts_the_motion(tmp_path, fault):
    plant, changes, _, message = FAULTS[fault]
    with pytest.raises(HardwareLost, match=f"(?s){message}"):
        moved(tmp_path, calibration(tmp_path, changes), **plant)


def test_a_right_calibration_and_a_whole_motion_fit(tmp_path):
    assert moved(tmp_path, calibration(tmp_path, {}))
