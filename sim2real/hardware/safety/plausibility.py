"""Checks whether measured positions are physically possible: no jump, no frozen encoder, within the envelope."""

from collections.abc import Mapping

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.hardware.device import ReadingPart
from sim2real.hardware.safety.gate import GateConfig
from sim2real.leaps import STAMP_S, reach_rad

_SAMPLES = 3
"""Number of equal readings in a row after which an encoder counts as frozen."""
_MIN_SPEED_RATIO = 0.5
"""Share of its speed that a joint keeps at least from one reading to the next."""


def require_parts(parts: Mapping[str, np.ndarray], declared: Mapping[str, ReadingPart]) -> None:
    """Raise SafetyStop if a part of a reading is missing, has another shape, or has impossible values."""
    for name, part in declared.items():
        values = np.asarray(parts.get(name, np.zeros(0)), np.float64)
        if name not in parts or values.shape != part.shape:
            fault = f"has the shape {values.shape}" if name in parts else "is missing"
            raise SafetyStop(f"part {name!r} of the reading {fault}, declared is {part.shape}")
        # NaN is in no range.
        if not np.all((values >= part.low) & (values <= part.high)):
            raise SafetyStop(
                f"part {name!r} of the reading is {values.tolist()} {part.unit}, not {part.low:g} to {part.high:g}",
                hint="look at the sensor and its cable",
            )
        if part.norm is not None and not part.norm[0] <= (norm := float(np.linalg.norm(values))) <= part.norm[1]:
            raise SafetyStop(
                f"part {name!r} of the reading has the norm {norm:.4g}, not {part.norm[0]:g} to {part.norm[1]:g}",
                hint="look at the sensor and its cable",
            )


class Plausibility:
    """Checks measured positions against the gate's limits.

    **Jumps.** If a position changes by more than ``max_speed_rad_s`` times the time since the last sample, plus the
    uncertainty of times and readings, the robot is stopped.

    **Freeze.** The robot is stopped if a joint surely moved faster than ``freeze_rad_s`` from one reading to the next,
    and then reads exactly the same for ``freeze_s`` and three readings although a command pushes it: a motor needs time
    to stop. "Surely": more time may have passed between two samples than between their stamps, as the first may be
    older, and the second as late as its answer. An encoder that freezes just after a reading hardly moves until the
    next one, so half the speed before that reading counts, too.

    **Envelope.** A position outside of ``envelope_rad`` stops the robot.
    """

    def __init__(self, config: GateConfig) -> None:
        self._config = config
        self._fastest = np.asarray(np.inf if config.max_speed_rad_s is None else config.max_speed_rad_s, np.float64)
        self.reset()

    def reset(self) -> None:
        """Forget all measurements; called when torque goes on or off."""
        self._t_s: float | None = None
        self._unsure_s = 0.0
        self._position = self._since_s = self._speed = self._before = self._same = np.zeros(0)

    def check(self, position_rad: np.ndarray, t_s: float, unsure_s: float, pushed: np.ndarray) -> None:
        """Check a measurement.

        Args:
            position_rad: Shape (n,): the joints' positions [rad].
            t_s: Time of the measurement [s].
            unsure_s: Uncertainty of that time [s].
            pushed: Shape (n,), bool: whether the last command pushes each joint.

        Raises:
            SafetyStop: A position is not a number, jumped, lies outside of the envelope, or has frozen.
        """
        # Check the envelope first: the angle of another joint may be no number.
        self._require_inside(position_rad)
        self._require_finite(position_rad)
        if self._t_s is None or len(position_rad) != len(self._position):
            self._begin(position_rad, t_s, unsure_s)
            return
        # Jumps: no joint is faster than its limit.
        elapsed_s = max(0.0, t_s - self._t_s)
        self._require_reachable(position_rad, elapsed_s + unsure_s + self._unsure_s)
        self._t_s, self._unsure_s = t_s, unsure_s
        # Keep for each joint the smallest speed that explains its last motion; two samples of one time give none.
        moved = position_rad != self._position
        if elapsed_s > 0.0:
            speed = np.abs(position_rad - self._position) / (elapsed_s + STAMP_S + unsure_s)
            self._speed[moved] = np.maximum(speed, _MIN_SPEED_RATIO * self._before)[moved]
            self._before = speed
        # Freeze: the time counts from the last motion.
        self._position = position_rad.copy()
        self._since_s[moved] = t_s + unsure_s
        self._same = np.where(moved, 0, self._same + 1)
        self._require_no_freeze(t_s, pushed)

    def _begin(self, position_rad: np.ndarray, t_s: float, unsure_s: float) -> None:
        n = len(position_rad)
        self._t_s, self._unsure_s, self._position = t_s, unsure_s, position_rad.copy()
        # Speed of each joint [rad/s]: before it stood still, and between the last two samples.
        self._speed, self._before = np.zeros(n), np.zeros(n)
        self._since_s, self._same = np.full(n, t_s), np.zeros(n, np.int64)

    def _require_finite(self, position_rad: np.ndarray) -> None:
        """Refuse NaN, which passes every comparison."""
        for i in np.flatnonzero(~np.isfinite(position_rad)):
            raise SafetyStop(
                f"{self._config.joint(int(i))} reads {position_rad[i]} rad, which is not an angle",
                hint="look at the encoder and the cable",
            )

    def _require_inside(self, position_rad: np.ndarray) -> None:
        if self._config.envelope_rad is None:
            return
        low, high = (np.broadcast_to(np.asarray(e, np.float64), position_rad.shape) for e in self._config.envelope_rad)
        beyond = np.nan_to_num(np.maximum(low - position_rad, position_rad - high), nan=-np.inf)
        worst = int(np.argmax(beyond))
        if beyond[worst] > 0.0:
            raise SafetyStop(
                f"{self._config.joint(worst)} is at {position_rad[worst]:.4g} rad, outside of its envelope, "
                f"{low[worst]:.4g} to {high[worst]:.4g} rad",
                hint="bring it back by hand; envelope_rad sets the limits",
            )

    def _require_reachable(self, position_rad: np.ndarray, elapsed_s: float) -> None:
        limit = np.broadcast_to(self._fastest, position_rad.shape)
        most = reach_rad(limit, elapsed_s)
        leap = np.abs(position_rad - self._position)
        if (leap > most).any():
            worst = int(np.argmax(leap - most))
            raise SafetyStop(
                f"{self._config.joint(worst)} reads {position_rad[worst]:.6g} rad, {leap[worst]:.6g} rad from the last "
                f"reading: at its fastest, {limit[worst]:.4g} rad/s, it can have moved by {most[worst]:.3g} rad",
                hint="look at the encoder and the cable; max_speed_rad_s sets the limit",
            )

    def _require_no_freeze(self, t_s: float, pushed: np.ndarray) -> None:
        fast = self._speed > self._config.freeze_rad_s
        if not fast.any():
            return
        still_s = t_s - self._since_s
        lasting = (still_s >= self._config.freeze_s) & (self._same >= _SAMPLES)
        for i in np.flatnonzero(fast & lasting & pushed):
            raise SafetyStop(
                f"{self._config.joint(int(i))} has read {self._position[i]:.6g} rad for {still_s[i]:.2f} s, "
                f"but moved at {self._speed[i]:.2g} rad/s or more just before",
                hint="is its encoder stuck, or did it hit something? freeze_rad_s sets the limit",
            )
