"""The motors of a Go2: names, limits, commands, and the safe stop: damp until the robot lies, then torque off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.unitree.messages import (
    HEAD,
    LOW_LEVEL,
    MOTORS,
    NO_POSITION,
    NO_VELOCITY,
    OFF,
    SERVO,
    LowCmd,
    LowState,
)

if TYPE_CHECKING:
    from sim2real.hardware.unitree.dds import DdsLink

NAMES: Final = tuple(f"{leg}_{joint}" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
"""The motors in the order of the messages."""
COLUMNS: Final = ("q", "dq", "kp", "kd", "tau")
"""Columns of a motor's command: its torque is ``tau + kp (q - measured q) + kd (dq - measured dq)``."""
_HIP, _CALF = (-1.0472, 1.0472), (-2.7227, -0.83776)
_FRONT, _REAR = (-1.5708, 3.4907), (-0.5236, 4.5379)
RANGE_RAD: Final = np.array([_HIP, _FRONT, _CALF] * 2 + [_HIP, _REAR, _CALF] * 2)
"""Lowest and highest angle of each joint [rad], ``(12, 2)``, from Unitree's description of the Go2."""
TORQUE_NM: Final = np.array([23.7, 23.7, 45.4] * 4)
"""Largest torque of each motor [N m], from the same description."""
_STILL_RAD_S, _STILL_S = 0.2, 0.3
"""The robot lies when all joints have been below this speed [rad/s] for this time [s]."""
_PERIOD_S: Final = 0.01
"""Time between two commands if no state comes [s]."""
_HELD_S: Final = 0.05
"""Shortest time for which "off" is published, because a command may be lost or overtaken [s]."""


@dataclass(frozen=True)
class LegDrive:
    """Limits of the commands, and of the safe stop.

    Args:
        kp_max: Largest position gain [N m/rad].
        kd_max: Largest velocity gain [N m s/rad].
        speed_max: Largest goal of the speed [rad/s].
        damping: Velocity gain of damping legs [N m s/rad].
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
    """Return the signed command with the columns of each motor, ``(12, 5)`` in the messages' order."""
    message = off()
    motors = message.record["motor_cmd"][:MOTORS]
    motors["mode"] = SERVO
    for name, column in zip(COLUMNS, columns.T, strict=True):
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


def motors_on(state: LowState) -> list[str]:
    """Return the names of the motors whose torque is on."""
    modes = state.record["motor_state"]["mode"][:MOTORS]
    return [name for name, mode in zip(NAMES, modes.tolist(), strict=True) if mode != OFF]


def sit_down(robot: DdsLink, drive: LegDrive, give_up_s: float, alive: Callable[[], None] = lambda: None) -> str:
    """Let the motors damp until the robot lies, then take their torque off until every motor confirms it.

    If the motors are off already, only "off" is sent. If no states come, all commands are sent.

    Args:
        give_up_s: Longest time for the motors to confirm that they are off [s].
        alive: Called between commands.

    Returns:
        The reason if the motors do not confirm, else "".
    """
    # Damp, unless a state received after this call shows that all motors are off.
    while robot.next_state(0.0) is not None:
        pass
    state = _state(robot, 5 * _PERIOD_S)
    if state is None or motors_on(state):
        _damp(robot, drive, alive)
    # Take the torque off.
    message, begin_s, confirmed = off(), robot.now_s(), False
    while (passed_s := robot.now_s() - begin_s) < give_up_s:
        if confirmed and passed_s >= _HELD_S:
            return ""
        robot.write(message)
        alive()
        state = _state(robot, _PERIOD_S)
        confirmed = state is not None and not motors_on(state)
    if state is None:
        return f"the robot has sent no state for {give_up_s:g} s"
    return f"{', '.join(motors_on(state))} did not switch off for {give_up_s:g} s"


def _damp(robot: DdsLink, drive: LegDrive, alive: Callable[[], None]) -> None:
    message, begin_s, still_s = drive.damp(), robot.now_s(), None
    while (now_s := robot.now_s()) - begin_s < drive.lie_s:
        robot.write(message)
        alive()
        state = _state(robot, _PERIOD_S)
        speeds = np.inf if state is None else np.abs(state.record["motor_state"]["dq"][:MOTORS])
        if not np.all(speeds < _STILL_RAD_S):
            still_s = None
        elif still_s is None:
            still_s = now_s
        elif now_s - still_s >= _STILL_S:
            return


def _state(robot: DdsLink, timeout_s: float) -> LowState | None:
    """Return the next state that is intact, or None after the timeout."""
    end_s = robot.now_s() + timeout_s
    while (left_s := end_s - robot.now_s()) > 0.0:
        state = robot.next_state(left_s)
        if state is not None and state.intact:
            return state
    return None
