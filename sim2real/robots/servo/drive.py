"""Position-controlled servos on a bus: their measurements, commands and port."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.identification.model import Channel
from sim2real.robots.loop import ACTUATOR
from sim2real.robots.messages import Goals, JointReading
from sim2real.robots.probe import Probe
from sim2real.robots.robot import RobotDrive, RobotSensor
from sim2real.robots.servo.servos import Servos
from sim2real.robots.session import Embedded, Session

if TYPE_CHECKING:
    from sim2real.hardware.device import Device, Reading
    from sim2real.hardware.safety.gate import GateConfig
    from sim2real.hardware.safety.limits import GateLimits

_HOLD_S = 1.0
"""How long an excitation's last goals are repeated [s]."""
HOME_RAD_S = 1.0
"""Speed of joints on the way to the rest pose."""
_AT_HOME_RAD, _AT_END_S = 0.1, 0.5


class JointSensor(RobotSensor):
    """Positions and velocities of all joints, of one reading."""

    units = MappingProxyType({"position": "rad", "velocity": "rad/s"})

    def __init__(self, servos: Servos, position_sigma_rad: float = 0.002, velocity_sigma_rad_s: float = 0.05) -> None:
        sigmas, names = (position_sigma_rad, velocity_sigma_rad_s), servos.names
        self.channels = tuple(
            Channel("position", "velocity", *sigmas, index=i, label=name, goal="goal") for i, name in enumerate(names)
        )
        self.at_rest = JointReading(servos.at_rest, np.zeros(len(names)))

    def read(self, reading: Reading) -> JointReading:
        """Return the message of a reading."""
        return JointReading(reading.position_rad, reading.velocity_rad_s)


class ServoDrive(RobotDrive):
    """Goals of all servos in one transaction.

    Args:
        embedded: Returns the emulated robot; None: there is none.
        settings: Returns the settings of the device on a port; default: those of the data sheet.
    """

    command, units, message = "goal", MappingProxyType({"goal": "rad"}), Goals
    expected_delay_s = (0.004, 0.003, 0.002)

    def __init__(
        self,
        servos: Servos,
        *,
        rate_hz: float = 50.0,
        probe: Probe | None = None,
        embedded: Callable[[], Embedded | None] | None = None,
        settings: Callable[[str], Any] | None = None,
    ) -> None:
        self.servos, self.rate_hz, self.probe = servos, rate_hz, probe
        self._embedded, self._settings = embedded, settings

    @property
    def embedded(self) -> Embedded | None:
        """The emulated robot, for the port ``embedded``."""
        return self._embedded() if self._embedded else None

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int, hanging: bool = False) -> Session:
        """Open the servos, with torque off; see ``RobotDrive.connect``."""
        settings = self._settings(port) if self._settings else self.servos.sheet.drive

        def device(port: str) -> Device:
            return self.make_device(port, settings, limits.servo_watchdog_s)

        # Position 0 of a plain joint is where the servo's encoder is at half a turn.
        embedded, mounting = self.embedded, self.servos.mounting
        embedded = embedded and embedded.mounted(mounting, math.pi)
        return Session(port, device, self.gate(limits), embedded, truth_path, seed, mounting)

    def make_device(self, port: str, settings: Any, silence_s: float) -> Device:
        """Return the servos on a port, not opened yet; ``silence_s``: longest silence while torque is on [s]."""
        from sim2real.hardware.registry import load_device

        s = self.servos
        return load_device(s.device)(port, s.ids, settings, baud_rate=s.baud_rate, silence_s=silence_s)

    def gate(self, limits: GateLimits) -> GateConfig:
        """Return a gate that holds the last goals when commands are stale."""
        s = self.servos
        low, high = np.maximum(s.low, -limits.limit), np.minimum(s.high, limits.limit)
        return limits.gate((tuple(low), tuple(high)), stale="hold", node=ACTUATOR, joints=s.names)

    def prepare(self, session: Session, settle_s: float) -> None:
        """Bring the joints to rest, slowly; torque is off before and afterwards.

        Raises:
            HardwareLost: The robot does not come to rest within ``settle_s`` [s] per attempt.
            SafetyStop: The robot rests at another position, or the gate stopped it.
        """
        bring_home(session, self.servos, self.rate_hz, settle_s)

    def around(self, signal: np.ndarray) -> np.ndarray:
        """Return goals ``(N, joints)`` [rad] of an excitation around the middle positions."""
        return signal + np.asarray(self.servos.middle or 0.0)

    def approach(self, session: Session, commands: np.ndarray) -> np.ndarray:
        """Return goals ``(N, joints)`` [rad]: joints move to the first ones at 1 rad/s instead of in a leap."""
        return approached(commands, session.rig.measure().position_rad, self.rate_hz)


def approached(goals: np.ndarray, position_rad: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return goals ``(N, joints)`` that begin at positions ``(joints,)`` and reach the given goals at 1 rad/s [rad]."""
    # Repeat the last goals: joints that began farther away than the excitation lasts go on towards them.
    goals = np.vstack([goals, np.repeat(goals[-1:], round(_HOLD_S * rate_hz), axis=0)])
    offset = position_rad - goals[0]
    covered = np.arange(len(goals))[:, None] * HOME_RAD_S / rate_hz
    return goals + np.sign(offset) * np.maximum(np.abs(offset) - covered, 0.0)


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
        for step in range(1, steps + round(_AT_END_S * rate_hz)):
            rig.measure()
            rig.command(position + min(1.0, step / steps) * way, 0.0, 1e-9 * rig.clock.now_ns())
            rig.clock.sleep(1 / rate_hz)
    except BaseException:
        rig.stop_quietly()  # a failure here must not replace the reason
        raise
    rig.stop()
