"""The safe way out of a robot on legs: its motors damp until it lies, then the torque goes off."""

from collections.abc import Callable
from typing import Final

import numpy as np

from sim2real.hardware.unitree.dds import DdsLink
from sim2real.hardware.unitree.legs import NAMES, LegDrive, off
from sim2real.hardware.unitree.messages import MOTORS, OFF, LowState

_STILL_RAD_S: Final = 0.2
"""A joint this slow has come to rest."""
_STILL_S: Final = 0.3
"""Time for which all joints are that slow when the robot lies."""
_PERIOD_S: Final = 0.01
"""Time between two commands if no state comes."""
_HELD_S: Final = 0.05
"""Shortest time for which "off" is published, as a command may be lost or overtaken."""


def sit_down(robot: DdsLink, drive: LegDrive, give_up_s: float, alive: Callable[[], None] = lambda: None) -> str:
    """Let the motors damp until the robot lies, then take their torque off until every motor confirms it.

    A robot whose motors are off already gets "off" alone. A robot whose states do not come gets all the same commands.

    Args:
        give_up_s: Longest time for the motors to confirm that they are off [s].
        alive: Called between commands.

    Returns:
        The reason if the motors do not confirm, else "".
    """
    # Damp, if a state that is not older than this call shows motors on.
    while robot.next_state(0.0) is not None:
        pass
    state = _state(robot, 5 * _PERIOD_S)
    if state is None or motors_on(state):
        _damp(robot, drive, alive)
    # Take the torque off.
    command, begin_s, confirmed = off(), _now_s(robot), False
    while (passed_s := _now_s(robot) - begin_s) < give_up_s:
        if confirmed and passed_s >= _HELD_S:
            return ""
        robot.write(command)
        alive()
        state = _state(robot, _PERIOD_S)
        confirmed = state is not None and not motors_on(state)
    if state is None:
        return f"the robot has sent no state for {give_up_s:g} s"
    return f"{', '.join(motors_on(state))} did not switch off for {give_up_s:g} s"


def motors_on(state: LowState) -> list[str]:
    """Return the names of the motors whose torque is on."""
    modes = state.record["motor_state"]["mode"][:MOTORS]
    return [name for name, mode in zip(NAMES, modes.tolist(), strict=True) if mode != OFF]


def _damp(robot: DdsLink, drive: LegDrive, alive: Callable[[], None]) -> None:
    command, begin_s, still_s = drive.damp(), _now_s(robot), None
    while (now_s := _now_s(robot)) - begin_s < drive.lie_s:
        robot.write(command)
        alive()
        state = _state(robot, _PERIOD_S)
        speeds = np.inf if state is None else np.abs(state.record["motor_state"]["dq"][:MOTORS])
        if not np.all(speeds < _STILL_RAD_S):
            still_s = None
        else:
            still_s = now_s if still_s is None else still_s
            if now_s - still_s >= _STILL_S:
                return


def _state(robot: DdsLink, timeout_s: float) -> LowState | None:
    """Return the next state that is intact, or None after the timeout."""
    end_s = _now_s(robot) + timeout_s
    while (left_s := end_s - _now_s(robot)) > 0.0:
        state = robot.next_state(left_s)
        if state is not None and state.intact:
            return state
    return None


def _now_s(robot: DdsLink) -> float:
    return 1e-9 * robot.clock.now_ns()
