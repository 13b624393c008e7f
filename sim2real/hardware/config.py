"""What no command gets past; every field is a flag of the stages that move a robot. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.errors import UsageError


@dataclass(frozen=True)
class GateLimits:
    """The safety gate: what no command gets past."""

    limit: float = 2.0
    """Largest command in either direction [the actuator's unit: V for the pendulum, rad for the arm]."""
    slew_per_s: float = 400.0
    """Fastest change of the command [unit/s]."""
    command_timeout_s: float = 0.1
    """A command older than this becomes zero volts; servos in position mode hold where they are [s]."""
    max_speed_rad_s: float = 60.0
    """Joint speed above which the robot is stopped [rad/s]; so is one whose position leaps further than that allows."""
    stuck_effort: float = 0.2
    """A joint that is pushed both ways with more than this share of its torque must move, or the robot is stopped."""
    servo_watchdog_s: float = 0.1
    """Longest silence on the bus: then the guardian takes the torque off, and servos that do so stop [s]; of 20 ms."""

    def __post_init__(self) -> None:
        """Check that each limit keeps something out and lets something through."""
        for name in ("limit", "slew_per_s", "command_timeout_s", "max_speed_rad_s", "stuck_effort"):
            if not getattr(self, name) > 0.0:
                raise UsageError(f"gate.{name} must be above 0, got {getattr(self, name)}")
        if not 0.02 <= self.servo_watchdog_s <= 2.54:
            raise UsageError(f"gate.servo_watchdog_s must lie in [0.02, 2.54] s, got {self.servo_watchdog_s}")
