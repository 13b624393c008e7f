"""The slow motion of a robot of servos to its rest pose; torque is off before and afterwards."""

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.robots.robot import Session
from sim2real.robots.servo.servos import Servos

HOME_RAD_S = 1.0
"""Speed of joints on the way to the rest pose."""
_AT_HOME_RAD, _HOLD_S = 0.1, 0.5


def bring_home(session: Session, servos: Servos, rate_hz: float, settle_s: float) -> None:
    """Bring the joints to their rest pose.

    Args:
        settle_s: Longest time to come to rest, for each try [s].

    Raises:
        HardwareLost: The robot does not come to rest.
        SafetyStop: It rests in another pose, or the gate stopped it.
    """
    rest = np.asarray(servos.at_rest)
    position = session.rig.wait_until_still(settle_s).position_rad
    if np.max(np.abs(position - rest)) > _AT_HOME_RAD:
        _move(session, position, rest, rate_hz)  # a joint without weight stays where it was left
        position = session.rig.wait_until_still(settle_s).position_rad
    error = np.abs(position - rest)
    worst = int(np.argmax(error))
    if error[worst] > servos.rest_tolerance:
        raise SafetyStop(
            f"joint {servos.names[worst]!r} rests at {position[worst]:.2f} rad, "
            f"not within {servos.rest_tolerance:g} rad of {rest[worst]:g} rad",
            hint="free it, or check the zero of its encoder",
        )


def _move(session: Session, position: np.ndarray, rest: np.ndarray, rate_hz: float) -> None:
    rig, way = session.rig, rest - position
    steps = int(np.ceil(np.max(np.abs(way)) / HOME_RAD_S * rate_hz))
    rig.start()
    try:
        for step in range(1, steps + round(_HOLD_S * rate_hz)):
            rig.measure()
            rig.command(position + min(1.0, step / steps) * way, 0.0, 1e-9 * rig.clock.now_ns())
            rig.clock.sleep(1 / rate_hz)
    except BaseException:
        rig.stop_quietly()  # a failure here must not replace the reason
        raise
    rig.stop()
