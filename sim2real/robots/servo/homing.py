"""A robot of servos on its way to where it rests: slowly, and torque is off before and afterwards."""

from __future__ import annotations

import time

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.robots.control_loop.hardware import ServoSession
from sim2real.robots.servo.servos import Servos

HOME_RAD_S = 1.0
"""How fast joints are brought to where they rest."""
_AT_HOME_RAD, _HOLD_S = 0.1, 0.5


def bring_home(session: ServoSession, servos: Servos, rate_hz: float, settle_s: float) -> None:
    """Bring the joints to where they rest.

    Args:
        settle_s: How long it may take to come to rest, a try [s].

    Raises:
        HardwareLost: It does not come to rest.
        SafetyStop: It rests somewhere else, or what the gate stopped.
    """
    rest = np.asarray(servos.at_rest)
    position = session.rig.wait_until_still(settle_s).position_rad
    if np.max(np.abs(position - rest)) > _AT_HOME_RAD:
        _move(session, position, rest, rate_hz)  # a joint without weight stays where it was left
        position = session.rig.wait_until_still(settle_s).position_rad
    off = np.abs(position - rest)
    worst = int(np.argmax(off))
    if off[worst] > servos.rest_tolerance:
        raise SafetyStop(
            f"joint {servos.names[worst]!r} rests at {position[worst]:.2f} rad, "
            f"not within {servos.rest_tolerance:g} rad of {rest[worst]:g} rad",
            hint="free it, or check the zero of its encoder",
        )


def _move(session: ServoSession, position: np.ndarray, rest: np.ndarray, rate_hz: float) -> None:
    rig, way = session.rig, rest - position
    steps = int(np.ceil(np.max(np.abs(way)) / HOME_RAD_S * rate_hz))
    rig.start()
    try:
        for step in range(1, steps + round(_HOLD_S * rate_hz)):
            rig.measure()
            rig.command(position + min(1.0, step / steps) * way, 0.0, time.monotonic())
            time.sleep(1 / rate_hz)
    except BaseException:
        rig.stop_quietly()  # the reason must not be lost to what else fails
        raise
    rig.stop()
