"""A robot's position servos: data sheet, limits, joints, measurements and commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.hardware import dynamixel, feetech
from sim2real.hardware.joint import Joint
from sim2real.identification.model import Channel
from sim2real.robots.loop import ACTUATOR
from sim2real.robots.messages import Goals, JointReading
from sim2real.robots.nodes import HOME_RAD_S
from sim2real.robots.probe import Probe
from sim2real.robots.robot import Embedded, RobotDrive

if TYPE_CHECKING:
    from sim2real.hardware.bus.registers import Family
    from sim2real.hardware.bus.servos import PositionDrive
    from sim2real.hardware.device import Device, Reading
    from sim2real.hardware.safety.gate import GateConfig, GateLimits
    from sim2real.hardware.safety.rig import Rig


@dataclass(frozen=True)
class DataSheet:
    """Data of a position-controlled servo, and its settings; the defaults are a DYNAMIXEL's.

    Attributes:
        stall: Torque at full duty and standstill [N m].
        damping: Back-EMF and viscous friction together, about ``stall`` divided by the no-load speed [N m s/rad].
        armature: Inertia of the rotor, as seen at the gear's output [kg m^2].
        friction: Dry friction [N m]; the value at standstill, if it decreases with speed.
        p_gain: Position P Gain [counts].
        d_gain: Position D Gain [counts].
        profile_rad_s: Profile Velocity [rad/s].
        model_number: Model number of the servos; a twin of the robot emulates that model's firmware.
        stribeck_rad_s: Speed at which 1/e of the dry friction is left [rad/s]; None: it does not depend on speed.
    """

    stall: float
    damping: float
    armature: float
    friction: float
    p_gain: int = 800
    d_gain: int = 0
    profile_rad_s: float = 5.0
    model_number: int = 1060
    stribeck_rad_s: float | None = None
    family: ClassVar[Family] = dynamixel.FAMILY

    @property
    def full_rad(self) -> float:
        """Position error at which the duty is full [rad]."""
        return self.family.full_rad / self.p_gain

    @property
    def gain(self) -> float:
        """Torque per position error [N m/rad]."""
        return self.stall / self.full_rad

    @property
    def drive(self) -> PositionDrive:
        """The drive with these settings, for the robot's device."""
        from sim2real.hardware.bus.servos import PositionDrive

        return PositionDrive(self.p_gain, self.profile_rad_s, self.d_gain)


@dataclass(frozen=True)
class StsSheet(DataSheet):
    """Data of a Feetech STS servo; its device is ``feetech``. Default settings are LeRobot's."""

    p_gain: int = 16
    d_gain: int = 32
    profile_rad_s: float = math.inf
    model_number: int = 777
    family = feetech.FAMILY


@dataclass(frozen=True)
class Servos:
    """The servos on the bus, in the order of the joints.

    Attributes:
        joints: Names, or joints with zero, direction and gear; a zero is the device's reading at the joint's angle 0.
        ids: Numbers on the bus.
        low: Lowest goals [rad].
        high: Highest goals [rad].
        sheet: Data sheet and settings.
        speed: Largest speed of a policy's goals [rad/s].
        rest: Positions of the joints without torque [rad]; default: 0.
        rest_tolerance: Largest distance of an episode's start from ``rest`` [rad].
        middle: Centre of excitations [rad]; default: 0.
        baud_rate: Baud rate of the bus.
        device: Name of the device; see `sim2real.hardware.registry`.
    """

    joints: tuple[Joint | str, ...]
    ids: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    sheet: DataSheet
    speed: float = 1.5
    rest: tuple[float, ...] = ()
    rest_tolerance: float = 0.4
    middle: tuple[float, ...] = ()
    baud_rate: int = 1_000_000
    device: str = "dynamixel"

    @property
    def mounting(self) -> tuple[Joint, ...]:
        """The joints."""
        return tuple(Joint.of(joint) for joint in self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names."""
        return tuple(joint.name for joint in self.mounting)

    @property
    def gears(self) -> tuple[float, ...]:
        """Turns of each servo for one turn of its joint."""
        return tuple(joint.gear for joint in self.mounting)

    @property
    def at_rest(self) -> np.ndarray:
        """Positions of the joints without torque, ``(joints,)`` [rad]."""
        return np.asarray(self.rest or np.zeros(len(self.joints)), np.float64)


_AT_HOME_RAD, _AT_END_S = 0.1, 0.5


class ServoDrive(RobotDrive):
    """Positions and velocities of all joints in one transaction, and goals of all servos in another.

    Args:
        embedded: Returns the emulated robot; None: there is none.
        settings: Returns the device's settings, given whether it is emulated; default: the data sheet's.
    """

    command, message = "goal", Goals
    units = MappingProxyType({"position": "rad", "velocity": "rad/s", "goal": "rad"})
    expected_delay_s = (0.004, 0.003, 0.002)

    def __init__(
        self,
        servos: Servos,
        *,
        rate_hz: float = 50.0,
        probe: Probe | None = None,
        embedded: Callable[[], Embedded | None] | None = None,
        settings: Callable[[bool], Any] | None = None,
    ) -> None:
        self.servos, self.rate_hz, self.probe = servos, rate_hz, probe
        self._embedded, self._settings = embedded, settings
        self.centre = np.asarray(servos.middle or 0.0)
        self.channels = tuple(
            Channel("position", "velocity", 0.002, 0.05, i, name, goal="goal") for i, name in enumerate(servos.names)
        )
        self.at_rest = JointReading(servos.at_rest, np.zeros(len(servos.names)))

    def read(self, reading: Reading) -> JointReading:
        return JointReading(reading.position_rad, reading.velocity_rad_s)

    @property
    def mounting(self) -> tuple[Joint, ...]:
        return self.servos.mounting

    def embedded(self, hanging: bool = False) -> Embedded | None:
        # A joint without a mounting has its angle 0 where the servo's encoder reads half a turn.
        return replace(robot, zero_rad=math.pi) if self._embedded and (robot := self._embedded()) else None

    def device(self, port: str, silence_s: float, embedded: bool) -> Device:
        from sim2real.hardware.registry import load_device

        s, settings = self.servos, self._settings(embedded) if self._settings else self.servos.sheet.drive
        return load_device(s.device)(port, s.ids, settings, baud_rate=s.baud_rate, silence_s=silence_s)

    def gate(self, limits: GateLimits, device: Device | None = None) -> GateConfig:
        s = self.servos
        low, high = np.maximum(s.low, -limits.limit), np.minimum(s.high, limits.limit)
        return limits.gate((tuple(low), tuple(high)), stale="hold", node=ACTUATOR, joints=s.names)

    def prepare(self, rig: Rig, settle_s: float) -> None:
        """Bring the joints to rest, slowly; torque is off before and afterwards.

        Raises:
            HardwareLost: The robot does not come to rest within ``settle_s`` [s] per attempt.
            SafetyStop: The robot rests at another position, or the gate stopped it.
        """
        rest = self.servos.at_rest
        position = rig.wait_until_still(settle_s).position_rad
        if np.max(np.abs(position - rest)) > _AT_HOME_RAD:
            self._move(rig, position, rest)  # a joint that carries no weight stays where it was left
            position = rig.wait_until_still(settle_s).position_rad
        error = np.abs(position - rest)
        worst = int(np.argmax(error))
        if error[worst] > self.servos.rest_tolerance:
            raise SafetyStop(
                f"joint {self.servos.names[worst]!r} rests at {position[worst]:.2f} rad, "
                f"not within {self.servos.rest_tolerance:g} rad of {rest[worst]:g} rad",
                hint="free it, or check the zero of its encoder",
            )

    def _move(self, rig: Rig, position: np.ndarray, rest: np.ndarray) -> None:
        way = rest - position
        steps = int(np.ceil(np.max(np.abs(way)) / HOME_RAD_S * self.rate_hz))
        with rig.running():
            for step in range(1, steps + round(_AT_END_S * self.rate_hz)):
                rig.measure()
                rig.command(position + min(1.0, step / steps) * way, 0.0, 1e-9 * rig.clock.now_ns())
                rig.clock.sleep(1 / self.rate_hz)
