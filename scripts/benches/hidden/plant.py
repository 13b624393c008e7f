"""A hidden pendulum as the plant of an emulated servo, for the wall clock; run by the emulator's process."""

from __future__ import annotations

import math
import random
from typing import Any

_PWM_MODE, _SUPPLY_V = 16, 5.0


class HiddenPlant:
    """The dynamics of ``hidden.robots.Hidden``; measurements have the encoder's play and noise.

    Args:
        gain: Acceleration per volt [rad/s^2/V].
        gravity: Largest acceleration by gravity [rad/s^2].
        damping: Of the speed [1/s].
        friction: Coulomb friction [rad/s^2].
        play: Half of the encoder's backlash [rad].
        noise: Deviation of a measured angle [rad].
        speed_noise: Deviation of a measured speed [rad/s].
        step_s: Of the integration [s].
    """

    servo_ids = (1,)

    def __init__(
        self, gain: float, gravity: float, damping: float, friction: float, play: float, noise: float,
        speed_noise: float, seed: int, step_s: float = 5e-4,
    ) -> None:  # fmt: skip
        self._truth = {"gain": gain, "gravity": gravity, "damping": damping, "friction": friction}
        self._gain, self._gravity, self._damping, self._friction = gain, gravity, damping, friction
        self._play, self._noise, self._speed_noise, self._random = play, noise, speed_noise, random.Random(seed)
        self._step_s, self._steps, self._volts, self._driven = step_s, 0, 0.0, False
        self._angle = self._encoder = math.pi
        self._speed = 0.0

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s], with friction."""
        step_s = self._step_s
        for _ in range(round(t_s / step_s) - self._steps):
            pushed = self._gain * self._volts + self._gravity * math.sin(self._angle) - self._damping * self._speed
            free = self._speed + step_s * pushed
            self._speed = math.copysign(max(abs(free) - step_s * self._friction, 0.0), free)
            self._angle += step_s * self._speed
            self._encoder = min(max(self._encoder, self._angle - self._play), self._angle + self._play)
            self._steps += 1

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set the voltage: ``goal`` is its share of the supply; 0 with torque off."""
        del servo_id
        self._driven = mode == _PWM_MODE
        self._volts = goal * _SUPPLY_V if self._driven else 0.0

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle [rad], velocity [rad/s] and load, none."""
        del servo_id
        angle, speed = self._encoder, self._speed
        if self._driven:  # the noise is the motor driver's
            angle += self._random.gauss(0.0, self._noise)
            speed += self._random.gauss(0.0, self._speed_noise)
        return angle, speed, 0.0

    def state(self) -> dict[str, float]:
        """Return the true angle [rad], velocity [rad/s] and voltage [V]."""
        return {"th": self._angle, "thdot": self._speed, "voltage": self._volts}

    def truth(self) -> dict[str, Any]:
        """Return the true parameters, in the units of ``pipelines/pendulum/model.py``."""
        return dict(self._truth)
