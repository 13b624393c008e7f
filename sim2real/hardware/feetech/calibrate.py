"""Follows a motion by hand on the bus, and makes a calibration of it, in LeRobot's format."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

from sim2real.errors import HardwareLost
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.device import StsServos
from sim2real.hardware.feetech.hand_motion import HandMotion

_PERIOD_S: Final = 0.02
_LONGEST_S: Final = 600.0
_CENTRE: Final = 2047
"""Count of the middle of a joint's travel, as in LeRobot."""


def follow(servos: StsServos, motion: HandMotion, show: Callable[[str], None]) -> None:
    """Read the open servos, without torque, until the motion is complete.

    Args:
        show: Called with each new instruction.

    Raises:
        HardwareLost: The motion contradicts the calibration, or is not complete after 10 minutes.
    """
    clock, printed = servos.clock, ""
    begun_ns = clock.now_ns()
    while (now_s := 1e-9 * (clock.now_ns() - begun_ns)) < _LONGEST_S:
        if motion.instruction != printed:
            printed = motion.instruction
            show(printed)
        counts, _ = servos.link.read_counts(servos.ids, (reg.PRESENT_POSITION,), "read of the position")
        if motion.feed(now_s, counts[:, 0]):
            return
        clock.sleep(_PERIOD_S)
    raise HardwareLost(f"the arm was not moved as asked within {_LONGEST_S:.0f} s: {printed}")


def write_calibration(servos: StsServos, motion: HandMotion, path: Path) -> None:
    """Write the homing offsets into the servos, and the calibration file.

    A servo's count is 2047 in the middle of its joint's travel; of a joint without stops in the middle pose.
    """
    link, entries = servos.link, {}
    bounded = {n.joint for n in motion.nudges if n.travel_rad is not None}
    for i, joint in enumerate(motion.joints):
        # The encoder's count is that of the register and the offset together.
        old = link.read(joint.servo_id, reg.HOMING_OFFSET)
        stops = joint.name in bounded
        middle = (motion.low[i] + motion.high[i]) / 2 if stops else motion.middle[i]
        turn = reg.COUNTS_PER_REVOLUTION
        offset = int((round(middle) + old - _CENTRE + turn // 2) % turn - turn // 2)
        offset = max(offset, reg.HOMING_OFFSET.minimum)
        half = (motion.high[i] - motion.low[i]) / 2
        low, high = (round(_CENTRE - half), round(_CENTRE + half)) if stops else (0, turn - 1)
        # Without the lock the servo keeps the values when its power goes.
        link.set(joint.servo_id, reg.LOCK, 0)
        for register, value in ((reg.HOMING_OFFSET, offset), (reg.MIN_POSITION, low), (reg.MAX_POSITION, high)):
            link.set(joint.servo_id, register, value)
        link.set(joint.servo_id, reg.LOCK, 1)
        entries[joint.name] = {
            "id": joint.servo_id,
            "drive_mode": int(motion.directions[joint.name] < 0),
            "homing_offset": offset,
            "range_min": low,
            "range_max": high,
        }
    path.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
