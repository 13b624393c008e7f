"""The setpoint of emulated position servos: it moves to the goal with limited speed and acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sim2real.hardware.plant import ConfigurablePlant, OperatingMode, Plant


@dataclass
class _Setpoint:
    """Where a servo's setpoint goes, and how fast it may.

    Attributes:
        goal_rad: Where it ends; None: the servo is not in position mode.
        at_rad: Where it is [rad].
        speed_rad_s: How fast it moves.
        top_rad_s: How fast it may move.
        gain_rad_s2: How fast its speed may change.
    """

    goal_rad: float | None = None
    at_rad: float = 0.0
    speed_rad_s: float = 0.0
    top_rad_s: float = math.inf
    gain_rad_s2: float = math.inf

    def advance(self, goal_rad: float, step_s: float) -> float:
        """Move towards the goal for a step of time, so that it comes to rest there; return where it is [rad]."""
        left = goal_rad - self.at_rad
        change = self.gain_rad_s2 * step_s
        stopping = math.inf  # the fastest speed from which it can still stop at the goal, one step from now on
        if math.isfinite(change):
            stopping = math.sqrt(2.0 * self.gain_rad_s2 * abs(left) + change**2 / 4) - change / 2
        wanted = math.copysign(min(self.top_rad_s, stopping, abs(left) / step_s), left)
        speed = min(max(wanted, self.speed_rad_s - change), self.speed_rad_s + change)
        there = abs(left - speed * step_s) < 1e-12 or (abs(speed) <= change and abs(left) <= abs(speed) * step_s)
        self.speed_rad_s = 0.0 if there else speed
        self.at_rad = goal_rad if there else self.at_rad + speed * step_s
        return self.at_rad


class ProfiledPlant:
    """A plant whose position servos are sent the setpoint of a profile, once a step, in the place of their goal.

    Args:
        plant: The plant; its own profile stays unlimited.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.servo_ids = plant.servo_ids
        self._t_s = 0.0
        self._setpoints = {i: _Setpoint() for i in plant.servo_ids}

    def advance(self, t_s: float) -> None:
        """Move the setpoints and integrate the plant up to a time [s]."""
        for servo_id, setpoint in self._setpoints.items():
            goal_rad = setpoint.goal_rad
            if goal_rad is not None and goal_rad != setpoint.at_rad:
                self._plant.command(servo_id, OperatingMode.POSITION, setpoint.advance(goal_rad, t_s - self._t_s))
        self._t_s = t_s
        self._plant.advance(t_s)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo; see `Plant.command`.

        Args:
            mode: As in `Plant.command`.
            goal: As in `Plant.command`.
        """
        setpoint = self._setpoints[servo_id]
        if mode != OperatingMode.POSITION:
            setpoint.goal_rad = None
            self._plant.command(servo_id, mode, goal)
            return
        if setpoint.goal_rad is None:
            setpoint.at_rad, setpoint.speed_rad_s = self._plant.measure(servo_id)[0], 0.0
            self._plant.command(servo_id, mode, setpoint.at_rad)
        setpoint.goal_rad = goal

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller, and the top speed of its setpoint.

        Args:
            p_gain: P gain [counts].
            d_gain: D gain [counts].
            profile_velocity_rad_s: Top speed of the setpoint [rad/s].
        """
        self._setpoints[servo_id].top_rad_s = profile_velocity_rad_s
        if isinstance(self._plant, ConfigurablePlant):
            self._plant.configure(servo_id, p_gain, d_gain, math.inf)

    def accelerate(self, servo_id: int, acceleration_rad_s2: float) -> None:
        """Set how fast the speed of a servo's setpoint may change [rad/s^2]."""
        self._setpoints[servo_id].gain_rad_s2 = acceleration_rad_s2

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return position [rad], velocity [rad/s] and load; see `Plant.measure`."""
        return self._plant.measure(servo_id)

    def state(self) -> dict[str, float]:
        """Return the plant's true state."""
        return self._plant.state()

    def truth(self) -> dict[str, Any]:
        """Return the plant's true parameters."""
        return self._plant.truth()
