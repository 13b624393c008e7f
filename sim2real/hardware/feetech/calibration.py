"""LeRobot's calibration file: the servo, the zero and the range of each joint.

    {"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1365, "range_min": 746, "range_max": 3477}, ...}

The servo stores `homing_offset`, and subtracts it from its encoder's count; the range is in counts after that.
LeRobot's angles in degrees are zero in the middle of the range (`motors_bus.py`, MotorNormMode.DEGREES), as here.
Its `drive_mode` 1 mirrors the joint. A turn has 4095 counts for LeRobot, 4096 here: 0.02 % of an angle.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim2real.errors import UsageError
from sim2real.hardware.feetech import registers as reg

_FIELDS: Final = {
    "id": (0, 253),
    "drive_mode": (0, 1),
    "homing_offset": (reg.HOMING_OFFSET.minimum, reg.HOMING_OFFSET.maximum),
    "range_min": (0, reg.COUNTS_PER_REVOLUTION - 1),
    "range_max": (0, reg.COUNTS_PER_REVOLUTION - 1),
}


@dataclass(frozen=True)
class CalibratedJoint:
    """A joint that a servo moves: angle = direction * gear * (count - zero_count) * (2 pi / 4096).

    Args:
        zero_count: The servo's count at the joint's zero [counts].
        direction: 1, or -1 if the joint's angle falls as the count rises.
        gear: Turns of the joint per turn of the servo [1].
        homing_offset: Offset in the servo for which the other counts hold, checked at `open`; None: not checked.
    """

    name: str
    servo_id: int
    zero_count: float = 2048.0
    direction: int = 1
    low_count: int = 0
    high_count: int = reg.COUNTS_PER_REVOLUTION - 1
    gear: float = 1.0
    homing_offset: int | None = None

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise UsageError(f"joint {self.name!r}: direction = {self.direction} is neither 1 nor -1")
        if not 0.0 < self.gear < math.inf:
            raise UsageError(f"joint {self.name!r}: gear = {self.gear} must be larger than 0")
        if not 0 <= self.low_count < self.high_count < reg.COUNTS_PER_REVOLUTION:
            raise UsageError(
                f"joint {self.name!r}: {self.low_count} to {self.high_count} counts is no range within 0 to 4095"
            )

    @property
    def rad_per_count(self) -> float:
        """Change of the angle with the count [rad]."""
        return self.direction * self.gear * reg.RAD_PER_COUNT

    @property
    def range_rad(self) -> tuple[float, float]:
        """Lowest and highest angle [rad]."""
        ends = sorted(self.angle(count) for count in (self.low_count, self.high_count))
        return ends[0], ends[1]

    def angle(self, count: float) -> float:
        """Return the joint's angle [rad] at a count of its servo."""
        return (count - self.zero_count) * self.rad_per_count

    def count(self, angle_rad: float) -> int:
        """Return the servo's count nearest to an angle of the joint [rad]."""
        return round(self.zero_count + angle_rad / self.rad_per_count)


def read_calibration(path: Path | str, travel_rad: Mapping[str, float] | None = None) -> tuple[CalibratedJoint, ...]:
    """Read LeRobot's calibration of an arm: `~/.cache/huggingface/lerobot/calibration/robots/so101_follower/*.json`.

    The zero of a joint is the middle of its range, so a wrong range moves the zero. A joint that passes from count 4095
    to count 0 while its range is recorded gets the range 0 to 4095, for any travel.

    Args:
        travel_rad: Joint -> angle from stop to stop [rad]; other joints may have any range, as one that turns freely.

    Raises:
        UsageError: There is no such file, it is not a calibration, or a range is far from the joint's travel.
    """
    # Read the file.
    path = Path(path)
    try:
        motors = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_unique)
    except OSError as error:
        raise UsageError(f"calibration file {path} cannot be read: {error.strerror}", hint=_HINT) from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"calibration file {path} is not valid JSON: {error}", hint=_HINT) from error
    if not isinstance(motors, dict) or not motors:
        raise UsageError(f"calibration file {path} holds no motors by name", hint=_HINT)
    # Make the joints, in the order of the file, and check that they fit together.
    joints = tuple(_joint(path, name, entry) for name, entry in motors.items())
    by_id: dict[int, str] = {}
    for joint in joints:
        other = by_id.setdefault(joint.servo_id, joint.name)
        if other != joint.name:
            raise UsageError(
                f"calibration file {path}: motors {other!r} and {joint.name!r} both have id {joint.servo_id}"
            )
        _check_range(path, joint, (travel_rad or {}).get(joint.name))
    return joints


def _check_range(path: Path, joint: CalibratedJoint, travel_rad: float | None) -> None:
    """Refuse a range that is far from the joint's travel; None: any range is accepted."""
    if travel_rad is None:
        return
    # Compare the recorded range with the joint's travel.
    counts = joint.high_count - joint.low_count
    travel_counts = travel_rad / abs(joint.rad_per_count)
    least, most = (share * travel_counts for share in _SHARE_OF_TRAVEL)
    if least <= counts <= most:
        return
    # Name the probable cause.
    cause = (
        "the joint passed from count 4095 to count 0 while its range was recorded"
        if counts >= _WHOLE_TURN * reg.COUNTS_PER_REVOLUTION
        else "the joint was not moved from stop to stop, or its counts passed from 4095 to 0, or it is another arm"
    )
    raise UsageError(
        f"calibration file {path}: motor {joint.name!r} has the range {joint.low_count} to {joint.high_count}, "
        f"{counts} counts, but from stop to stop the joint turns by about {round(travel_counts)} counts "
        f"({math.degrees(travel_rad):.0f} degrees). The joint's zero, the middle of the range, would be wrong. "
        f"Probable cause: {cause}",
        hint="calibrate again: begin with every joint in the middle of its travel, then move each from stop to stop",
    )


_SHARE_OF_TRAVEL: Final = (0.75, 1.3)
"""Least and largest range that a joint may have, as a share of its travel. Of SO-101 calibrations that are public the
ranges are 0.81 to 1.27 of the description's travel, the most at grippers; those across the encoder's seam 1.6 to 3.3.
"""
_WHOLE_TURN: Final = 0.97
"""Share of a revolution from which on a range is called a whole turn."""
_HINT: Final = "lerobot-calibrate writes one"


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object as a dict; raise ValueError if it has a name twice, as one of them would be lost."""
    names = [name for name, _ in pairs]
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{duplicates[0]!r} is there twice")
    return dict(pairs)


def _joint(path: Path, name: str, entry: Any) -> CalibratedJoint:
    # Check the fields and their values.
    where = f"calibration file {path}: motor {name!r}"
    if not isinstance(entry, dict):
        raise UsageError(f"{where} is no object with {', '.join(_FIELDS)}", hint=_HINT)
    for problem, keys in (("lacks", _FIELDS.keys() - entry.keys()), ("has an unknown", entry.keys() - _FIELDS.keys())):
        if keys:
            raise UsageError(f"{where} {problem} {sorted(keys)[0]!r}. Available: {', '.join(_FIELDS)}", hint=_HINT)
    for key, (low, high) in _FIELDS.items():
        value = entry[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise UsageError(f"{where}: {key} = {value!r} is no whole number in [{low}, {high}]", hint=_HINT)
    if entry["range_min"] >= entry["range_max"]:
        raise UsageError(
            f"{where}: range_min = {entry['range_min']} is not below range_max = {entry['range_max']}",
            hint="was the joint moved while its range was recorded? calibrate again",
        )
    # The zero is the middle of the range, as in LeRobot.
    return CalibratedJoint(
        name=name,
        servo_id=entry["id"],
        zero_count=(entry["range_min"] + entry["range_max"]) / 2,
        direction=-1 if entry["drive_mode"] else 1,
        low_count=entry["range_min"],
        high_count=entry["range_max"],
        homing_offset=entry["homing_offset"],
    )
