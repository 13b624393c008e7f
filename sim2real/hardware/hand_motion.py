"""A person moves the joints by hand, with torque off: which servo moves which joint, in which direction, how far.

Everything here is computed from counts of the encoders; no servo is written.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.servos import ServoJoint

MOVED_RAD: Final = 0.3
"""Motion of a joint from which on it counts as moved [rad]."""
END_RAD: Final = 0.1
"""Largest distance of a joint's stop from the end of its calibrated range [rad]; the zero, the middle of both, is
then wrong by at most as much."""
MIDDLE_RAD: Final = 0.7
"""Largest distance of a joint from its zero in the middle pose, which a person finds by eye [rad]."""
_STILL_RAD, _STILL_S, _SETTLED_S = 0.05, 0.5, 1.0
_PATIENCE_S: Final = 6.0
"""How long all joints rest before a stop that was not reached counts as a finding [s]."""
_POSED_S: Final = 3.0
"""How long all joints rest in a wrong middle pose before it counts as a finding [s]."""
_LEAST_OF_TRAVEL: Final = 0.75
_CALIBRATE: Final = "calibrate again: begin with every joint in the middle, then move each from stop to stop"


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


@dataclass
class HandMotion:
    """Follows a motion by hand through its three parts: the middle pose, a nudge of each joint, all stops.

    Attributes:
        joints: The robot's joints. Uncalibrated ones have a range of a whole turn and no homing offset.
        nudges: The motions, in the order of the instructions.
        directions: Joint -> sign of its counts in the direction of its angle; complete after the nudges.
        low: Lowest counts, unwrapped, ``(joints,)``.
        high: Highest counts, unwrapped, ``(joints,)``.
        middle: Counts in the middle pose, ``(joints,)``.
    """

    joints: Sequence[ServoJoint]
    nudges: Sequence[Nudge]
    calibrated: bool
    directions: dict[str, int] = field(default_factory=dict)
    low: np.ndarray = field(default_factory=lambda: np.zeros(0))
    high: np.ndarray = field(default_factory=lambda: np.zeros(0))
    middle: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Start before the first measurement."""
        self._names = [joint.name for joint in self.joints]
        self._counts = self._anchor = self._base = np.zeros(0)
        self._still_since_s = 0.0
        self._first = np.zeros(0)
        self._waiting = False

    @property
    def instruction(self) -> str:
        """The present instruction."""
        if not self.middle.size:
            return "hold the arm with every joint in the middle of its travel, and keep it still for a second"
        if len(self.directions) < len(self.nudges):
            nudge = self.nudges[len(self.directions)]
            return f"{nudge.joint}: {nudge.words}, then back"
        names = [n.joint for n in self.nudges if n.travel_rad is not None and not self._reached(n)]
        return f"move to both stops: {', '.join(names) or 'done'}"

    def feed(self, t_s: float, counts: np.ndarray) -> bool:
        """Take the counts ``(joints,)`` at a time [s]; return whether the motion is complete.

        Raises:
            HardwareLost: The motion contradicts the calibration, or the assembly of the arm.
        """
        still_s = self._follow(t_s, counts)
        if not self.middle.size:
            self._find_middle(still_s)
            return False
        self.low, self.high = np.minimum(self.low, self._counts), np.maximum(self.high, self._counts)
        if self.calibrated:
            self._require_within()
        if len(self.directions) < len(self.nudges):
            self._find_nudge(still_s)
            return False
        return self._find_stops(still_s)

    def _follow(self, t_s: float, counts: np.ndarray) -> float:
        """Unwrap the counts at the encoder's seam; return for how long all joints have rested [s]."""
        if not self._counts.size:
            self._counts = self._anchor = self._first = counts.astype(np.float64)
            self._still_since_s = t_s
        half = reg.COUNTS_PER_REVOLUTION / 2
        change = (counts - self._counts + half) % reg.COUNTS_PER_REVOLUTION - half
        self._counts = self._counts + change
        if np.any(np.abs(self._counts - self._anchor) * reg.RAD_PER_COUNT > _STILL_RAD):
            self._anchor, self._still_since_s = self._counts, t_s
        return t_s - self._still_since_s

    def _find_middle(self, still_s: float) -> None:
        """Take the pose at rest: a calibrated arm's has angles near 0, another arm has been moved before."""
        if still_s < _SETTLED_S:
            return
        moved = bool(np.any(np.abs(self._counts - self._first) * reg.RAD_PER_COUNT > MOVED_RAD))
        off = [joint.angle(count) for joint, count in zip(self.joints, self._counts, strict=True)]
        bounded = {n.joint for n in self.nudges if n.travel_rad is not None}
        wrong = [i for i, a in enumerate(off) if self._names[i] in bounded and abs(a) > MIDDLE_RAD]
        # An arm that was not moved yet lies where it was put away.
        if not moved and (wrong or not self.calibrated):
            return
        if self.calibrated and wrong:
            if still_s < _POSED_S:
                return
            angles = ", ".join(f"{self._names[i]} {math.degrees(off[i]):.0f} degrees" for i in wrong)
            raise HardwareLost(
                f"in the middle pose these joints should be near 0 degrees, and are at: {angles}",
                hint=f"hold the arm in the middle pose and start again; if it was there, {_CALIBRATE}",
            )
        self.middle = self.low = self.high = self._base = self._counts

    def _find_nudge(self, still_s: float) -> None:
        """Compare the servo that moves with the joint of the instruction."""
        # Between two nudges, wait until the arm rests.
        if self._waiting:
            if still_s >= _STILL_S:
                self._waiting, self._base = False, self._counts
            return
        nudge = self.nudges[len(self.directions)]
        moved = (self._counts - self._base) * reg.RAD_PER_COUNT
        # A joint that was nudged before is identified: its motion decides nothing.
        open_ = [i for i, name in enumerate(self._names) if name not in self.directions]
        far = [i for i in open_ if abs(moved[i]) > MOVED_RAD]
        if not far:
            return
        if len(far) > 1:
            both = " and ".join(self._names[i] for i in far)
            raise HardwareLost(f"{both} moved together", hint="start again, and move one joint at a time")
        (i,) = far
        if self._names[i] != nudge.joint:
            raise HardwareLost(
                f"{nudge.joint} was to be moved, but servo {self.joints[i].servo_id}, {self._names[i]}, turned",
                hint="two servos have exchanged ids, or another joint was moved: lerobot-setup-motors sets ids",
            )
        sign = int(np.sign(moved[i]))
        if self.calibrated and sign * self.joints[i].direction != nudge.direction:
            raise HardwareLost(
                f"{nudge.joint} turned in the other direction than '{nudge.words}': by the calibration its angle "
                f"{'fell' if nudge.direction > 0 else 'rose'}",
                hint="its servo is mounted turned, or drive_mode of the calibration is wrong",
            )
        self.directions[nudge.joint] = sign * nudge.direction
        self._waiting = True

    def _require_within(self) -> None:
        """Refuse a joint that turns beyond its calibrated range."""
        for nudge in self.nudges:
            i = self._names.index(nudge.joint)
            joint = self.joints[i]
            beyond = max(joint.low_count - self.low[i], self.high[i] - joint.high_count) * reg.RAD_PER_COUNT
            if nudge.travel_rad is not None and beyond > END_RAD:
                seam = self.low[i] < 0 or self.high[i] >= reg.COUNTS_PER_REVOLUTION
                raise HardwareLost(
                    f"{nudge.joint} turns at least {math.degrees(beyond):.0f} degrees beyond its calibrated range"
                    f"{', across the seam between counts 4095 and 0' if seam else ''}: its zero is wrong",
                    hint=_CALIBRATE,
                )

    def _short_of(self, nudge: Nudge) -> tuple[float, float]:
        """Return the distances of the lowest and the highest count from the calibrated ends [rad]."""
        i = self._names.index(nudge.joint)
        joint = self.joints[i]
        low, high = self.low[i] - joint.low_count, joint.high_count - self.high[i]
        return low * reg.RAD_PER_COUNT, high * reg.RAD_PER_COUNT

    def _reached(self, nudge: Nudge) -> bool:
        """Whether a joint has been at both stops."""
        if self.calibrated:
            return max(self._short_of(nudge)) <= END_RAD
        i = self._names.index(nudge.joint)
        span = (self.high[i] - self.low[i]) * reg.RAD_PER_COUNT
        return span >= _LEAST_OF_TRAVEL * (nudge.travel_rad or 0.0)

    def _find_stops(self, still_s: float) -> bool:
        """Return whether all joints have been at both stops, and rest."""
        lacking = [n for n in self.nudges if n.travel_rad is not None and not self._reached(n)]
        if not lacking:
            return still_s >= _SETTLED_S
        # A joint that was moved to its stops rests, and yet is short of its calibrated range.
        for nudge in lacking if self.calibrated and still_s > _PATIENCE_S else []:
            i = self._names.index(nudge.joint)
            if (self.high[i] - self.low[i]) * reg.RAD_PER_COUNT >= _LEAST_OF_TRAVEL * (nudge.travel_rad or 0.0):
                raise HardwareLost(
                    f"{nudge.joint} stops {math.degrees(max(self._short_of(nudge))):.0f} degrees before the end of its "
                    "calibrated range: its zero is wrong, or it did not reach its stop",
                    hint=f"start again; if it was at both stops, {_CALIBRATE}",
                )
        return False
