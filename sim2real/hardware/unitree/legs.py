"""The motors of a Go2: names, limits, and the commands that keep it safe."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.unitree.messages import HEAD, LOW_LEVEL, MOTORS, NO_POSITION, NO_VELOCITY, OFF, SERVO, LowCmd

NAMES: Final = tuple(f"{leg}_{joint}" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
"""The motors in the order of the messages."""
_HIP, _CALF = (-1.0472, 1.0472), (-2.7227, -0.83776)
_FRONT, _REAR = (-1.5708, 3.4907), (-0.5236, 4.5379)
RANGE_RAD: Final = np.array([_HIP, _FRONT, _CALF] * 2 + [_HIP, _REAR, _CALF] * 2)
"""Lowest and highest angle of each joint [rad], ``(12, 2)``, of Unitree's description of the Go2."""
TORQUE_NM: Final = np.array([23.7, 23.7, 45.4] * 4)
"""Largest torque of each motor [N m], of the same description."""


@dataclass(frozen=True)
class LegDrive:
    """Limits of the commands, and the safe way out: the legs damp until they are still, then the torque goes off.

    Args:
        kp_max: Largest position gain [N m/rad].
        kd_max: Largest velocity gain [N m s/rad].
        speed_max: Largest goal of the speed [rad/s].
        damping: Velocity gain of legs that damp [N m s/rad].
        lie_s: Longest time that legs damp before the torque goes off [s].
    """

    kp_max: float = 200.0
    kd_max: float = 20.0
    speed_max: float = 30.0
    damping: float = 5.0
    lie_s: float = 4.0

    def __post_init__(self) -> None:
        if not (0.0 < self.damping <= self.kd_max and self.lie_s >= 0.0):
            raise UsageError(
                f"legs: damping = {self.damping:g} N m s/rad must be above 0 and at most kd_max = {self.kd_max:g}, "
                f"lie_s = {self.lie_s:g} s at least 0"
            )

    @property
    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest q, dq, kp, kd and tau of each motor, each ``(12, 5)``."""
        high = np.empty((MOTORS, 5))
        high[:, 0], high[:, 4] = RANGE_RAD[:, 1], TORQUE_NM
        high[:, 1:4] = self.speed_max, self.kp_max, self.kd_max
        low = -high
        low[:, 0], low[:, 2:4] = RANGE_RAD[:, 0], 0.0
        return low, high

    def damp(self) -> LowCmd:
        """Return the command that damps all motors."""
        return command(np.tile([NO_POSITION, 0.0, 0.0, self.damping, 0.0], (MOTORS, 1)))


def command(columns: np.ndarray) -> LowCmd:
    """Return the signed command with the q, dq, kp, kd and tau of each motor, ``(12, 5)`` in the messages' order."""
    message = off()
    motors = message.record["motor_cmd"][:MOTORS]
    motors["mode"] = SERVO
    for name, column in zip(("q", "dq", "kp", "kd", "tau"), columns.T, strict=True):
        motors[name] = column
    message.sign()
    return message


def off() -> LowCmd:
    """Return the signed command that takes the torque of all motors off."""
    message = LowCmd()
    message.record["head"], message.record["level_flag"] = HEAD, LOW_LEVEL
    motors = message.record["motor_cmd"]
    motors["mode"], motors["q"], motors["dq"] = OFF, NO_POSITION, NO_VELOCITY
    message.sign()
    return message
