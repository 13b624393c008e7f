"""Calibration of Feetech servos in LeRobot's format: the servo, the zero and the range of each joint.

    {"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1365, "range_min": 746, "range_max": 3477}, ...}

The servo stores `homing_offset`, and subtracts it from its encoder's count; the range is in counts after that.
LeRobot's angles in degrees are zero in the middle of the range (`motors_bus.py`, MotorNormMode.DEGREES), as here.
Its `drive_mode` 1 mirrors the joint. A turn has 4095 counts for LeRobot, 4096 here: 0.02 % of an angle.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import ServoJoint
from sim2real.hardware.feetech import StsServos

_HINT: Final = "lerobot-calibrate writes one"
_SHARE_OF_TRAVEL: Final = (0.75, 1.3)
"""Least and largest range that a joint may have, as a share of its travel. Of SO-101 calibrations that are public the
ranges are 0.81 to 1.27 of the description's travel, the most at grippers; those across the encoder's seam 1.6 to 3.3.
"""
_WHOLE_TURN: Final = 0.97
"""Share of a revolution from which on a range is called a whole turn."""
_MOVED_RAD: Final = 0.3
"""Motion of a joint by hand from which on it counts as moved [rad]."""
_END_RAD: Final = 0.1
"""Largest distance of a joint's stop from the end of its calibrated range [rad]; the zero, the middle of both, is
then wrong by at most as much."""
_MIDDLE_RAD: Final = 0.7
"""Largest distance of a joint from its zero in the middle pose, which a person finds by eye [rad]."""
_STILL_RAD, _STILL_S, _SETTLED_S = 0.05, 0.5, 1.0
_PATIENCE_S: Final = 6.0
"""How long all joints rest before a stop that was not reached counts as a finding [s]."""
_POSED_S: Final = 3.0
"""How long all joints rest in a wrong middle pose before it counts as a finding [s]."""
_LEAST_OF_TRAVEL: Final = 0.75
_CALIBRATE: Final = "calibrate again: begin with every joint in the middle, then move each from stop to stop"
_PERIOD_S: Final = 0.02
_LONGEST_S: Final = 600.0
_SCANS: Final = 3
_PATIENT_S: Final = 0.02  # answers of a USB adapter with a latency timer of 16 ms
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


def _check_range(path: Path, joint: ServoJoint, travel_rad: float | None) -> None:
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


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object as a dict; raise ValueError if it has a name twice, as one of them would be lost."""
    names = [name for name, _ in pairs]
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{duplicates[0]!r} is there twice")
    return dict(pairs)


def _joint(path: Path, name: str, entry: Any) -> ServoJoint:
    where = f"calibration file {path}: motor {name!r}"
    try:
        motor = msgspec.convert(entry, _Motor)
    except msgspec.ValidationError as error:
        raise UsageError(f"{where}: {error}", hint=_HINT) from error
    if motor.range_min >= motor.range_max:
        raise UsageError(
            f"{where}: range_min = {motor.range_min} is not below range_max = {motor.range_max}",
            hint="was the joint moved while its range was recorded? calibrate again",
        )
    # The zero is the middle of the range, as in LeRobot.
    middle, direction = (motor.range_min + motor.range_max) / 2, -1 if motor.drive_mode else 1
    joint = name, motor.id, middle, direction, motor.range_min, motor.range_max
    return ServoJoint(*joint, homing_offset=motor.homing_offset)


def find_servos(port: str, joints: Mapping[int, str], baud_rate: int) -> tuple[ServoJoint, ...]:
    """Return the robot's joints, with the homing offsets and limits that their servos hold. Writes nothing.

    Args:
        joints: Id -> joint, of all servos that the robot has.

    Raises:
        HardwareLost: No servo answers, they answer at another baud rate, or one is missing.
    """
    # Search the robot's own baud rate first.
    for rate in sorted(reg.BAUD_RATES, key=lambda rate: rate != baud_rate):
        config = BusConfig(port, rate, reply_timeout_s=_PATIENT_S, max_silence_s=1.0, guardian=False)
        link = ServoLink(config, reg.FAMILY, lambda answer, what: HardwareLost(f"{what}: error {answer.error}"))
        try:
            # At the expected rate a servo that is missing is searched again, as answers may be lost.
            answering: list[int] = []
            for _ in range(_SCANS if rate == baud_rate else 1):
                answering = sorted({*answering, *(i for i in link.scan() if i in joints or rate == baud_rate)})
                if set(joints) <= set(answering):
                    break
            if answering and rate != baud_rate:
                raise HardwareLost(
                    f"the servos {answering} on {port} answer at {rate} baud, not at {baud_rate}",
                    hint="lerobot-setup-motors gives each servo its id and its baud rate",
                )
            if missing := [f"{name!r} (id {i})" for i, name in joints.items() if answering and i not in answering]:
                raise HardwareLost(
                    f"no servo answers on {port} for the joint {' and '.join(missing)}. Ids that answer: {answering}",
                    hint="check the cables between the servos; two servos of one id garble each other's answers: "
                    "connect one at a time, and give it its id with lerobot-setup-motors",
                )
            if answering:
                return tuple(_present(link, i, name) for i, name in joints.items())
        finally:
            link.close()
    raise HardwareLost(
        f"no servo answers on {port}, at any baud rate of {list(reg.BAUD_RATES)}",
        hint="check that the servos have power, and that the port is that of the arm",
    )


def _present(link: ServoLink, servo_id: int, name: str) -> ServoJoint:
    registers = (reg.MIN_POSITION, reg.MAX_POSITION, reg.HOMING_OFFSET)
    low, high, offset = (link.read(servo_id, register, despite_error=True) for register in registers)
    # A servo with the limits 0 and 0 turns without end.
    low, high = (low, high) if low < high else (0, reg.COUNTS_PER_REVOLUTION - 1)
    return ServoJoint(name, servo_id, low_count=low, high_count=high, homing_offset=offset)


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

    It follows the counts of the encoders, and compares with the calibration which servo moves which joint, in which
    direction and how far.

    Args:
        joints: The robot's calibrated joints.
        nudges: The motions, in the order of the instructions.

    Attributes:
        instruction: The present instruction.
    """

    def __init__(self, joints: Sequence[ServoJoint], nudges: Sequence[Nudge]) -> None:
        self.joints, self.nudges = joints, nudges
        self._nudged: set[str] = set()
        self._low = self._high = self._counts = self._anchor = self._first = np.zeros(0)
        self._still_s = self._still_since_s = 0.0
        self._place = {joint.name: i for i, joint in enumerate(joints)}
        self._bounded = [nudge for nudge in nudges if nudge.travel_rad is not None]
        self._steps = self._follow()
        self.instruction = next(self._steps)

    def feed(self, t_s: float, counts: np.ndarray) -> bool:
        """Take the counts ``(joints,)`` at a time [s]; return whether the motion is complete.

        Raises:
            HardwareLost: The motion contradicts the calibration, or the assembly of the arm.
        """
        self._unwrap(t_s, counts)
        if self._low.size:
            self._low, self._high = np.minimum(self._low, self._counts), np.maximum(self._high, self._counts)
            self._require_within()
        try:
            self.instruction = next(self._steps)
        except StopIteration:
            return True
        return False

    def _follow(self) -> Iterator[str]:
        """Yield the instruction after each measurement, until the motion is complete."""
        middle = False
        while not middle:
            yield "hold the arm with every joint in the middle of its travel, and keep it still for a second"
            middle = self._is_in_the_middle()
        self._low = self._high = self._counts
        # A nudge begins at rest.
        for nudge in self.nudges:
            words = f"{nudge.joint}: {nudge.words}, then back"
            yield words
            while self._still_s < _STILL_S:
                yield words
            base = self._counts
            while not self._is_nudged(nudge, base):
                yield words
        while lacking := [nudge for nudge in self._bounded if max(self._short_of(nudge)) > _END_RAD]:
            self._require_reached(lacking)
            yield f"move to both stops: {', '.join(nudge.joint for nudge in lacking)}"
        while self._still_s < _SETTLED_S:
            yield "move to both stops: done"

    def _unwrap(self, t_s: float, counts: np.ndarray) -> None:
        """Unwrap the counts at the encoder's seam, and note for how long all joints have rested."""
        if not self._counts.size:
            self._counts = self._anchor = self._first = counts.astype(np.float64)
            self._still_since_s = t_s
        half = reg.COUNTS_PER_REVOLUTION / 2
        self._counts = self._counts + (counts - self._counts + half) % reg.COUNTS_PER_REVOLUTION - half
        if np.any(np.abs(self._counts - self._anchor) * reg.RAD_PER_COUNT > _STILL_RAD):
            self._anchor, self._still_since_s = self._counts, t_s
        self._still_s = t_s - self._still_since_s

    def _is_in_the_middle(self) -> bool:
        """Whether the pose at rest is the middle: its angles are near 0."""
        if self._still_s < _SETTLED_S:
            return False
        moved = bool(np.any(np.abs(self._counts - self._first) * reg.RAD_PER_COUNT > _MOVED_RAD))
        angles = {j.name: j.angle(count) for j, count in zip(self.joints, self._counts, strict=True)}
        wrong = [n.joint for n in self._bounded if abs(angles[n.joint]) > _MIDDLE_RAD]
        wrong.sort(key=self._place.__getitem__)
        # An arm that was not moved yet lies where it was put away.
        if not wrong:
            return True
        if not moved or self._still_s < _POSED_S:
            return False
        there = ", ".join(f"{name} {math.degrees(angles[name]):.0f} degrees" for name in wrong)
        raise HardwareLost(
            f"in the middle pose these joints should be near 0 degrees, and are at: {there}",
            hint=f"hold the arm in the middle pose and start again; if it was there, {_CALIBRATE}",
        )

    def _is_nudged(self, nudge: Nudge, base: np.ndarray) -> bool:
        """Whether the joint of the instruction has moved, in the direction of the calibration."""
        moved = (self._counts - base) * reg.RAD_PER_COUNT
        # A joint that was nudged before is identified: its motion decides nothing.
        far = [j for i, j in enumerate(self.joints) if j.name not in self._nudged and abs(moved[i]) > _MOVED_RAD]
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
        sign = int(np.sign(moved[self._place[joint.name]]))
        if sign * joint.direction != nudge.direction:
            raise HardwareLost(
                f"{nudge.joint} turned in the other direction than '{nudge.words}': by the calibration its angle "
                f"{'fell' if nudge.direction > 0 else 'rose'}",
                hint="its servo is mounted turned, or drive_mode of the calibration is wrong",
            )
        self._nudged.add(nudge.joint)
        return True

    def _require_within(self) -> None:
        """Refuse a joint that turns beyond its calibrated range."""
        for nudge in self._bounded:
            low, high = self._ends(nudge)
            beyond = -min(self._short_of(nudge))
            if beyond > _END_RAD:
                seam = low < 0 or high >= reg.COUNTS_PER_REVOLUTION
                raise HardwareLost(
                    f"{nudge.joint} turns at least {math.degrees(beyond):.0f} degrees beyond its calibrated range"
                    f"{', across the seam between counts 4095 and 0' if seam else ''}: its zero is wrong",
                    hint=_CALIBRATE,
                )

    def _require_reached(self, lacking: Sequence[Nudge]) -> None:
        """Refuse a joint that was moved to its stops, rests, and yet is short of its calibrated range."""
        for nudge in lacking if self._still_s > _PATIENCE_S else []:
            low, high = self._ends(nudge)
            if (high - low) * reg.RAD_PER_COUNT >= _LEAST_OF_TRAVEL * (nudge.travel_rad or math.inf):
                raise HardwareLost(
                    f"{nudge.joint} stops {math.degrees(max(self._short_of(nudge))):.0f} degrees before the end of its "
                    "calibrated range: its zero is wrong, or it did not reach its stop",
                    hint=f"start again; if it was at both stops, {_CALIBRATE}",
                )

    def _ends(self, nudge: Nudge) -> tuple[float, float]:
        i = self._place[nudge.joint]
        return float(self._low[i]), float(self._high[i])

    def _short_of(self, nudge: Nudge) -> tuple[float, float]:
        """Return the distances of the lowest and the highest count from the calibrated ends [rad]."""
        joint, (low, high) = self.joints[self._place[nudge.joint]], self._ends(nudge)
        return (low - joint.low_count) * reg.RAD_PER_COUNT, (joint.high_count - high) * reg.RAD_PER_COUNT


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
