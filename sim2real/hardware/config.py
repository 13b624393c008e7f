"""Limits of the safety gate, as flags of the stages that move a robot. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.errors import UsageError


@dataclass(frozen=True)
class GateLimits:
    """The limits of the safety gate, through which every command passes."""

    limit: float = 2.0
    """Largest magnitude of a command [the actuator's unit: V for the pendulum, rad for the arm]."""
    slew_per_s: float = 400.0
    """Largest rate of change of a command [the actuator's unit per second]."""
    command_timeout_s: float = 0.1
    """Age from which a command is replaced, by zero volts or, in position mode, by the last one (servos hold) [s]."""
    max_speed_rad_s: float = 60.0
    """Joint speed above which the robot is stopped, whether measured or computed from successive positions [rad/s]."""
    stuck_effort: float = 0.2
    """A joint driven both ways with more than this fraction of its torque must move, or the robot is stopped [1]."""
    servo_watchdog_s: float = 0.1
    """Longest silence on the bus; after it the guardian takes the torque off, and the servos' watchdogs trip [s]."""

    def __post_init__(self) -> None:
        """Check that all limits are in their ranges."""
        for name in ("limit", "slew_per_s", "command_timeout_s", "max_speed_rad_s", "stuck_effort"):
            if not getattr(self, name) > 0.0:
                raise UsageError(f"gate.{name} must be above 0, got {getattr(self, name)}")
        if not 0.02 <= self.servo_watchdog_s <= 2.54:
            raise UsageError(f"gate.servo_watchdog_s must lie in [0.02, 2.54] s, got {self.servo_watchdog_s}")
