"""The emulated turntable's physics: a table with dry friction, whose motor is in a speed loop."""

from __future__ import annotations

import math

from sim2real.hardware.device import OperatingMode

_COUNTS = 8192  # of the encoder, per turn


class Turntable:
    """A turntable; see `sim2real.emulation.plant.Plant`.

    Args:
        loop: What the speed loop does about an error of speed [1/s].
        friction: Dry friction over inertia [rad/s^2].
        drag: Viscous friction over inertia [1/s].
        step_s: Time step [s].
    """

    servo_ids = (0,)

    def __init__(self, loop: float = 20.0, friction: float = 12.0, drag: float = 0.0, step_s: float = 0.0005) -> None:
        self.loop, self.friction, self.drag, self.step_s = loop, friction, drag, step_s
        self.angle, self.speed, self.steps = 0.0, 0.0, 0
        self.goal: float | None = None  # None: torque is off

    def advance(self, t_s: float) -> None:
        """Integrate up to a time [s]."""
        for _ in range(round(t_s / self.step_s) - self.steps):
            drive = 0.0 if self.goal is None else self.loop * (self.goal - self.speed)
            free = self.speed + self.step_s * (drive - self.drag * self.speed)
            # Friction reduces the speed by at most this, and never reverses it.
            self.speed = math.copysign(max(0.0, abs(free) - self.step_s * self.friction), free)
            self.angle += self.step_s * self.speed
            self.steps += 1

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Take a speed [rad/s]; any other mode counts as torque off."""
        self.goal = goal if mode == OperatingMode.VELOCITY else None

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return the angle in whole counts [rad], the speed [rad/s], and no load."""
        count = 2.0 * math.pi / _COUNTS
        return count * round(self.angle / count), self.speed, 0.0

    def state(self) -> dict[str, float]:
        """Return the true state."""
        return {"position": self.angle, "velocity": self.speed}

    def truth(self) -> dict[str, float]:
        """Return what an identification should find."""
        return {"loop": self.loop, "friction": self.friction}
