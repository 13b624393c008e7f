"""Calibration of Feetech servos in LeRobot's format, and its check by a person who moves the arm by hand.

    {"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1365, "range_min": 746, "range_max": 3477}, ...}

`lerobot-calibrate` writes it. The servo stores `homing_offset`, and subtracts it from its encoder's count; the range is
in counts after that. LeRobot's angles in degrees are zero in the middle of the range (`motors_bus.py`,
MotorNormMode.DEGREES), as here. Its `drive_mode` 1 mirrors the joint. A turn has 4095 counts for LeRobot, 4096 here:
0.02 % of an angle.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.servos import ServoJoint
from sim2real.hardware.feetech import StsServos

_SHARE_OF_TRAVEL: Final = (0.75, 1.3)
"""Smallest and largest range of a joint, as a share of its travel. In public calibrations of SO-101 the ranges are 0.81
to 1.27 of the travel in the URDF, and 1.6 to 3.3 where the joint crossed the seam between counts 4095 and 0.
"""
_WHOLE_TURN: Final = 0.97
"""A range counts as a whole turn from this share of a revolution on."""
_MOVED_RAD: Final = 0.3
"""A joint counts as moved by hand if it turned by this angle [rad]."""
_END_RAD: Final = 0.1
"""Largest distance of a joint's stop from the end of its calibrated range [rad]; the zero, in the middle of the range,
is then wrong by at most this angle.
"""
_MIDDLE_RAD: Final = 0.7
"""Largest distance of a joint from its zero in the middle pose, which a person finds by eye [rad]."""
_STILL_RAD, _STILL_S, _SETTLED_S = 0.05, 0.5, 1.0
_POSED_S: Final = 3.0
"""A wrong middle pose is reported after all joints have rested in it for this time [s]."""
_CALIBRATE: Final = "calibrate again: begin with every joint in the middle, then move each from stop to stop"
_PERIOD_S: Final = 0.02
_LONGEST_S: Final = 600.0
_Count = Annotated[int, msgspec.Meta(ge=0, le=reg.COUNTS_PER_REVOLUTION - 1)]


class _Motor(msgspec.Struct, forbid_unknown_fields=True):
    id: Annotated[int, msgspec.Meta(ge=0, le=253)]
    drive_mode: Annotated[int, msgspec.Meta(ge=0, le=1)]
    homing_offset: Annotated[int, msgspec.Meta(ge=reg.HOMING_OFFSET.minimum, le=reg.HOMING_OFFSET.maximum)]
    range_min: _Count
    range_max: _Count


def read_calibration(path: Path | str, travel_rad: Mapping[str, float] | None = None) -> tuple[ServoJoint, ...]:
    """Read LeRobot's calibration of an arm: `~/.cache/huggingface/lerobot/calibration/robots/so101_follower/*.json`.

    The zero of a joint is the middle of its range, so a wrong range moves the zero. A joint that passes from count 4095
    to count 0 while its range is recorded gets the range 0 to 4095, for any travel.

    Args:
        travel_rad: Joint -> angle from stop to stop [rad]; the range of other joints is not checked.

    Raises:
        UsageError: There is no such file, it is not a calibration, or a range is far from the joint's travel.
    """
    where, hint = f"calibration file {path}", "lerobot-calibrate writes one"
    try:
        motors = msgspec.json.decode(Path(path).read_bytes(), type=dict[str, _Motor])
    except OSError as error:
        raise UsageError(f"{where} cannot be read: {error}", hint=hint) from error
    except msgspec.DecodeError as error:
        raise UsageError(f"{where}: {error}", hint=hint) from error
    if not motors:
        raise UsageError(f"{where} holds no motors", hint=hint)
    joints, names = [], {motor.id: name for name, motor in motors.items()}
    for name, motor in motors.items():
        if names[motor.id] != name:
            raise UsageError(f"{where}: motors {name!r} and {names[motor.id]!r} both have id {motor.id}")
        low, high = motor.range_min, motor.range_max
        if low >= high:
            raise UsageError(
                f"{where}: motor {name!r}: range_min = {low} is not below range_max = {high}",
                hint="was the joint moved while its range was recorded? calibrate again",
            )
        if travel_rad and name in travel_rad:
            _require_travel(f"{where}: motor {name!r}", low, high, travel_rad[name])
        direction = -1 if motor.drive_mode else 1
        joints.append(ServoJoint(name, motor.id, (low + high) / 2, direction, low, high, motor.homing_offset))
    return tuple(joints)


def _require_travel(where: str, low: int, high: int, travel_rad: float) -> None:
    """Refuse a range that is far from the joint's travel, and name the probable cause."""
    counts, travel_counts = high - low, travel_rad / reg.RAD_PER_COUNT
    if _SHARE_OF_TRAVEL[0] * travel_counts <= counts <= _SHARE_OF_TRAVEL[1] * travel_counts:
        return
    cause = (
        "the joint passed from count 4095 to count 0 while its range was recorded"
        if counts >= _WHOLE_TURN * reg.COUNTS_PER_REVOLUTION
        else "the joint was not moved from stop to stop, or its counts passed from 4095 to 0, or it is another arm"
    )
    raise UsageError(
        f"{where} has the range {low} to {high}, {counts} counts, but from stop to stop the joint turns by about "
        f"{round(travel_counts)} counts ({math.degrees(travel_rad):.0f} degrees). The joint's zero, the middle of the "
        f"range, would be wrong. Probable cause: {cause}",
        hint=_CALIBRATE,
    )


@dataclass(frozen=True)
class Nudge:
    """A small motion that a person makes with one joint.

    Attributes:
        words: The motion, as an instruction.
        direction: Sign of the joint's angle in that direction.
        travel_rad: Angle from stop to stop [rad]; None: the joint has no stops.
    """

    joint: str
    words: str
    direction: int
    travel_rad: float | None


class HandMotion:
    """A person moves the joints by hand, with torque off: the middle pose, a nudge of each joint, all stops.

    It reads the encoders, and checks against the calibration which servo moves which joint, in which direction, and how
    far.

    Args:
        joints: The robot's calibrated joints.
        nudges: The motions, in the order of the instructions.

    Attributes:
        instruction: The present instruction.
    """

    def __init__(self, joints: Sequence[ServoJoint], nudges: Sequence[Nudge]) -> None:
        self.joints, self.nudges = joints, nudges
        self._place = {joint.name: i for i, joint in enumerate(joints)}
        self._bounded = [self._place[nudge.joint] for nudge in nudges if nudge.travel_rad is not None]
        # Counts: now; at the first measurement; when all joints last moved; the lowest and highest so far.
        self._counts = self._first = self._anchor = self._low = self._high = np.zeros(0)
        self._still_s = self._still_since_s = 0.0
        self._steps = self._follow()
        self.instruction = next(self._steps)

    def feed(self, t_s: float, counts: np.ndarray) -> bool:
        """Take the counts ``(joints,)`` at a time [s]; return whether the motion is complete.

        Raises:
            HardwareLost: The motion contradicts the calibration, or the assembly of the arm.
        """
        if not self._counts.size:
            self._counts = self._first = self._anchor = counts.astype(np.float64)
            self._still_since_s = t_s
        # Unwrap the counts at the encoder's seam, and note for how long all joints have rested.
        half = reg.COUNTS_PER_REVOLUTION / 2
        self._counts = self._counts + (counts - self._counts + half) % reg.COUNTS_PER_REVOLUTION - half
        if np.any(self._moved(self._anchor) > _STILL_RAD):
            self._anchor, self._still_since_s = self._counts, t_s
        self._still_s = t_s - self._still_since_s
        if self._low.size:
            self._low, self._high = np.minimum(self._low, self._counts), np.maximum(self._high, self._counts)
            self._require_within()
        try:
            self.instruction = next(self._steps)
        except StopIteration:
            return True
        return False

    def _follow(self) -> Iterator[str]:
        """Yield the present instruction after each measurement, until the motion is complete."""
        yield (words := "hold the arm with every joint in the middle of its travel, and keep it still for a second")
        while not self._is_in_the_middle():
            yield words
        self._low = self._high = self._counts
        nudged: set[str] = set()
        for nudge in self.nudges:
            yield (words := f"{nudge.joint}: {nudge.words}, then back")
            while self._still_s < _STILL_S:  # a nudge begins at rest
                yield words
            base = self._counts
            while not self._is_nudged(nudge, base, nudged):
                yield words
            nudged.add(nudge.joint)
        while lacking := [i for i in self._bounded if max(self._short_of(i)) > _END_RAD]:
            yield f"move to both stops: {', '.join(self.joints[i].name for i in lacking)}"
        while self._still_s < _SETTLED_S:
            yield "move to both stops: done"

    def _moved(self, since: np.ndarray) -> np.ndarray:
        """Return the distance of each joint from its counts ``since`` [rad]."""
        return np.abs(self._counts - since) * reg.RAD_PER_COUNT

    def _is_in_the_middle(self) -> bool:
        """Return whether the pose at rest is the middle: its angles are near 0."""
        if self._still_s < _SETTLED_S:
            return False
        angles = [joint.angle(count) for joint, count in zip(self.joints, self._counts, strict=True)]
        wrong = [i for i in sorted(self._bounded) if abs(angles[i]) > _MIDDLE_RAD]
        # The arm still lies where it was put away: no joint was moved yet.
        if wrong and self._still_s >= _POSED_S and np.any(self._moved(self._first) > _MOVED_RAD):
            there = ", ".join(f"{self.joints[i].name} {math.degrees(angles[i]):.0f} degrees" for i in wrong)
            raise HardwareLost(
                f"in the middle pose these joints should be near 0 degrees, but are at {there}",
                hint=f"hold the arm in the middle pose and start again; if it was there, {_CALIBRATE}",
            )
        return not wrong

    def _is_nudged(self, nudge: Nudge, base: np.ndarray, nudged: set[str]) -> bool:
        """Return whether the joint of the instruction has moved, in the direction of the calibration."""
        # A joint that was nudged before is known already: ignore its motion.
        far = [self.joints[i] for i in np.flatnonzero(self._moved(base) > _MOVED_RAD).tolist()]
        far = [joint for joint in far if joint.name not in nudged]
        if not far:
            return False
        if len(far) > 1:
            both = " and ".join(joint.name for joint in far)
            raise HardwareLost(f"{both} moved together", hint="start again, and move one joint at a time")
        (joint,) = far
        if joint.name != nudge.joint:
            raise HardwareLost(
                f"{nudge.joint} was to be moved, but servo {joint.servo_id}, {joint.name}, turned",
                hint="two servos have exchanged ids, or another joint was moved: lerobot-setup-motors sets ids",
            )
        place = self._place[joint.name]
        if np.sign(self._counts[place] - base[place]) * joint.direction != nudge.direction:
            raise HardwareLost(
                f"{nudge.joint} turned in the other direction than '{nudge.words}': by the calibration its angle "
                f"{'fell' if nudge.direction > 0 else 'rose'}",
                hint="its servo is mounted the other way round, or drive_mode of the calibration is wrong",
            )
        return True

    def _require_within(self) -> None:
        """Refuse a joint that turns beyond its calibrated range."""
        for i in self._bounded:
            beyond = -min(self._short_of(i))
            if beyond > _END_RAD:
                seam = self._low[i] < 0 or self._high[i] >= reg.COUNTS_PER_REVOLUTION
                raise HardwareLost(
                    f"{self.joints[i].name} turns at least {math.degrees(beyond):.0f} degrees beyond its calibrated "
                    f"range{', across the seam between counts 4095 and 0' if seam else ''}: its zero is wrong",
                    hint=_CALIBRATE,
                )

    def _short_of(self, i: int) -> tuple[float, float]:
        """Return the distances of a joint's lowest and highest count from its calibrated ends [rad]."""
        low, high = self._low[i] - self.joints[i].low_count, self.joints[i].high_count - self._high[i]
        return low * reg.RAD_PER_COUNT, high * reg.RAD_PER_COUNT


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
