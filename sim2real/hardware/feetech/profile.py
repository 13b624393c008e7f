"""The setpoint of emulated position servos: it moves to the goal with limited speed and acceleration."""

import math
from dataclasses import dataclass
from typing import Any

from sim2real.hardware.plant import ConfigurablePlant, OperatingMode, Plant


@dataclass
class _Setpoint:
    """Goal, state and limits of a servo's setpoint; the goal is None if the servo is not in position mode."""

    goal_rad: float | None = None
    position_rad: float = 0.0
    speed_rad_s: float = 0.0
    top_rad_s: float = math.inf
    acceleration_rad_s2: float = math.inf

    def advance(self, goal_rad: float, step_s: float) -> float:
        """Move towards the goal for a step of time, so that it comes to rest there; return its position [rad]."""
        left = goal_rad - self.position_rad
        change = self.acceleration_rad_s2 * step_s
        # The highest speed from which it can still stop at the goal.
        stopping = math.inf
        if math.isfinite(change):
            stopping = math.sqrt(2.0 * self.acceleration_rad_s2 * abs(left) + change**2 / 4) - change / 2
        # The speed within all limits, and the step with it; a step across the goal ends there.
        wanted = math.copysign(min(self.top_rad_s, stopping, abs(left) / step_s), left)
        speed = min(max(wanted, self.speed_rad_s - change), self.speed_rad_s + change)
        there = abs(left - speed * step_s) < 1e-12 or (abs(speed) <= change and abs(left) <= abs(speed) * step_s)
        self.speed_rad_s = 0.0 if there else speed
        self.position_rad = goal_rad if there else self.position_rad + speed * step_s
        return self.position_rad


class ProfiledPlant:
    """A plant whose position servos get the setpoint of a profile at every step instead of their goal.

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
            if goal_rad is not None and goal_rad != setpoint.position_rad:
                self._plant.command(servo_id, OperatingMode.POSITION, setpoint.advance(goal_rad, t_s - self._t_s))
        self._t_s = t_s
        self._plant.advance(t_s)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo; see `Plant.command`."""
        setpoint = self._setpoints[servo_id]
        if mode != OperatingMode.POSITION:
            setpoint.goal_rad = None
            self._plant.command(servo_id, mode, goal)
            return
        if setpoint.goal_rad is None:
            setpoint.position_rad, setpoint.speed_rad_s = self._plant.measure(servo_id)[0], 0.0
            self._plant.command(servo_id, mode, setpoint.position_rad)
        setpoint.goal_rad = goal

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller, and the top speed of its setpoint."""
        self._setpoints[servo_id].top_rad_s = profile_velocity_rad_s
        if isinstance(self._plant, ConfigurablePlant):
            self._plant.configure(servo_id, p_gain, d_gain, math.inf)

    def accelerate(self, servo_id: int, acceleration_rad_s2: float) -> None:
        """Set the acceleration of a servo's setpoint [rad/s^2]."""
        self._setpoints[servo_id].acceleration_rad_s2 = acceleration_rad_s2

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return position [rad], velocity [rad/s] and load; see `Plant.measure`."""
        return self._plant.measure(servo_id)

    def state(self) -> dict[str, float]:
        """Return the plant's true state."""
        return self._plant.state()

    def truth(self) -> dict[str, Any]:
        """Return the plant's true parameters."""
        return self._plant.truth()
