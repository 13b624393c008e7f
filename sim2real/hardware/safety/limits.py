"""Limits of the safety gate, as flags of the stages that move a robot. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeAlias

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.hardware.safety.gate import GateConfig

GateLimit: TypeAlias = float | tuple[float | Sequence[float], float | Sequence[float]]

POSITIVE = (
    "command_timeout_s",
    "max_speed_rad_s",
    "freeze_rad_s",
    "first_step_rad",
    "following_rad",
    "max_sample_age_s",
    "stop_s",
)
"""Limits that must be above 0."""


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
    freeze_rad_s: float = 2.0
    """A joint that moved this fast and then reads the same for 0.05 s stops the robot: its encoder froze [rad/s]."""
    envelope_rad: tuple[float, float] | None = None
    """Range of joint angles, lowest and highest; outside of it the robot is stopped; default: not checked [rad]."""
    first_step_rad: float = 0.5
    """Largest distance of the first goal from the measured pose; a policy that starts farther away is refused [rad]."""
    following_rad: float | None = None
    """Largest distance of a joint from where its goals put it: beyond it the robot is stopped, as the joint let go, is
    blocked or slips; default: by the identified model, or by the servo's own figures; inf: not checked [rad]."""
    max_sample_age_s: float = 0.25
    """Age of the newest measurement above which the robot is stopped instead of commanded [s]."""
    stop_s: float = 0.5
    """Longest time in which the first Ctrl-C brings the robot to rest before the torque goes off [s]."""
    servo_watchdog_s: float = 0.1
    """Longest silence on the bus; after it the guardian takes the torque off, and the servos' watchdogs trip [s]."""

    def __post_init__(self) -> None:
        for name in ("limit", "slew_per_s", *POSITIVE):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise UsageError(f"gate.{name} must be above 0, got {value}")
        if not 0.02 <= self.servo_watchdog_s <= 2.54:
            raise UsageError(f"gate.servo_watchdog_s must lie in [0.02, 2.54] s, got {self.servo_watchdog_s}")
        if self.envelope_rad is not None and not self.envelope_rad[0] < self.envelope_rad[1]:
            raise UsageError(f"gate.envelope_rad must be the lowest and the highest angle, got {self.envelope_rad}")

    def gate(self, limit: GateLimit, **settings: Any) -> GateConfig:
        """Return the gate of a robot with these limits.

        Args:
            limit: Largest magnitude of a command, or (low, high) [the command's unit].
        """
        # Imported here because numpy takes 0.1 s, for which --help would wait.
        from sim2real.hardware.safety.gate import GateConfig

        limits = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("limit", "servo_watchdog_s")}
        return GateConfig(limit, **limits, **settings)
