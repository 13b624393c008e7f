"""Twelve servos whose speed follows their voltage: a plant with almost no cost for the emulator."""

from __future__ import annotations

import math

TIME_CONSTANT_S, TOP_RAD_S = 0.05, 6.0


class TwelveJoints:
    """Twelve motors without load."""

    servo_ids = tuple(range(1, 13))

    def __init__(self) -> None:
        self._t_s = 0.0
        self._angle = dict.fromkeys(self.servo_ids, 0.0)
        self._speed = dict.fromkeys(self.servo_ids, 0.0)
        self._goal = dict.fromkeys(self.servo_ids, 0.0)

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s], exactly."""
        step_s, self._t_s = t_s - self._t_s, t_s
        left = math.exp(-step_s / TIME_CONSTANT_S)
        for i in self.servo_ids:
            top = TOP_RAD_S * self._goal[i]
            self._angle[i] += top * step_s + (self._speed[i] - top) * TIME_CONSTANT_S * (1.0 - left)
            self._speed[i] = top + (self._speed[i] - top) * left

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set a motor's share of the supply voltage."""
        self._goal[servo_id] = goal if mode else 0.0

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle [rad], speed [rad/s] and load."""
        return self._angle[servo_id], self._speed[servo_id], self._goal[servo_id]

    def state(self) -> dict[str, float]:
        """Return the angles [rad]."""
        return {f"angle_{i}": angle for i, angle in self._angle.items()}

    def truth(self) -> dict[str, float]:
        """Return the parameters of all motors."""
        return {"time_constant_s": TIME_CONSTANT_S, "top_rad_s": TOP_RAD_S}
