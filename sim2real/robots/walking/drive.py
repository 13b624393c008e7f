"""Messages and drive of a walking robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.artifacts.identification import Noise
from sim2real.errors import SafetyStop, UsageError
from sim2real.graph.base import Base
from sim2real.identification.model import Channel
from sim2real.robots.robot import Embedded, RobotDrive
from sim2real.types import Array

if TYPE_CHECKING:
    from sim2real.hardware.device import Device, Reading
    from sim2real.hardware.safety.gate import GateConfig, GateLimits
    from sim2real.hardware.safety.rig import Rig
    from sim2real.robots.walking.robot import ComposedRobot


@pytree.dataclass
class BodyReading(Base):
    """A measurement of encoders and IMU.

    Attributes:
        position: Shape ``(joints,)`` [rad].
        velocity: Shape ``(joints,)`` [rad/s].
        quaternion: Shape ``(4,)``: orientation of the base in the world, w first.
        gyro: Shape ``(3,)``: angular velocity in the axes of the base [rad/s].
    """

    position: Array
    velocity: Array
    quaternion: Array
    gyro: Array


@pytree.dataclass
class LegCommand(Base):
    """The command of the motors, each ``(joints,)``: its torque is ``tau + kp (q - position) + kd (dq - velocity)``.

    Attributes:
        q: Targets [rad].
        dq: Velocities [rad/s].
        kp: Gains of the position [N m/rad].
        kd: Gains of the velocity [N m s/rad].
        tau: Torques [N m].
    """

    q: Array
    dq: Array
    kp: Array
    kd: Array
    tau: Array


def leg_command(q: Array, kp: float, kd: float) -> LegCommand:
    """Return the command of targets ``(joints,)`` with the same gains for all motors."""
    xp = namespace(q)
    zero = xp.zeros_like(q)
    return LegCommand(q, zero, zero + kp, zero + kd, zero)


def into_base(quaternion: Array, vector: Any) -> Array:
    """Return a vector of the world ``(3,)`` in the axes of the base.

    Args:
        quaternion: Shape ``(4,)``, w first; normalised, because the mean of two orientations is shorter than 1.
    """
    xp = namespace(quaternion, vector)
    unit = quaternion / xp.sqrt(xp.sum(quaternion**2))
    w, u = unit[0], -unit[1:]
    vector = xp.asarray(vector, dtype=unit.dtype)
    return vector + 2.0 * xp.cross(u, xp.cross(u, vector) + w * vector)


def gravity_of(quaternion: Array) -> Array:
    """Return the direction of gravity in the axes of the base, ``(3,)``; ``(0, 0, -1)`` while the base is level."""
    return into_base(quaternion, (0.0, 0.0, -1.0))


Place = Literal["floor", "stand"]
_STILL_RAD_S = 0.3
"""Speed below which a joint is at rest, above the noise of the motors' speeds [rad/s]."""
_BENT = 0.25
"""How far a standing robot bends its legs, as a share of the way from the stance to folded legs."""
_LARGEST = {"dq": 1.0, "kp": 120.0, "kd": 8.0, "tau": 1.0}
"""Largest magnitude of dq, kp, kd and tau [rad/s, N m/rad, N m s/rad, N m]; kp and kd are at least 0."""


@dataclass(frozen=True)
class LegMotors:
    """The motors of a walking robot on hardware.

    Attributes:
        device: Name of the device; see ``sim2real.hardware.registry``.
        folded: Position of each joint while the robot lies on folded legs, from which it stands up [rad].
        settings: Settings of the device.
        embedded: Returns the emulated robot, on the ``floor`` or in a ``stand``; None: there is none.
    """

    device: str
    folded: tuple[float, ...]
    settings: Any = None
    embedded: Callable[[Place], Embedded] | None = None


@dataclass(frozen=True)
class StandUp:
    """The start motion: fold the legs, rise to the stance, and wait there.

    Attributes:
        fold_s, rise_s, wait_s: Durations of the three phases [s].
        kp, kd: Gains during the motion [N m/rad], [N m s/rad]; with small gains, weak motors do not lift the robot.
    """

    fold_s: float = 0.8
    rise_s: float = 1.2
    wait_s: float = 0.6
    kp: float = 60.0
    kd: float = 3.0

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""
        return self.fold_s + self.rise_s + self.wait_s

    def targets(self, t_s: float, start: np.ndarray, folded: np.ndarray, stance: np.ndarray) -> np.ndarray:
        """Return the joints' targets ``(joints,)`` at a time of the motion [rad]."""
        fold, rise = (float(np.clip(x, 0.0, 1.0)) for x in (t_s / self.fold_s, (t_s - self.fold_s) / self.rise_s))
        return start + fold * (folded - start) + rise * (stance - folded)


class WalkingDrive(RobotDrive):
    """Measures encoders, orientation and gyro; commands targets of all joints, with the same gains for all motors.

    Without motors the robot has no device, and its policy walks only on the twin.

    Attributes:
        crouch: Offset from the stance to bent legs, for a recording on the feet ``(joints,)`` [rad].
    """

    centre: np.ndarray
    command = "q"
    units = MappingProxyType(
        {"position": "rad", "velocity": "rad/s", "quaternion": "1", "gyro": "rad/s"}
        | {"q": "rad", "dq": "rad/s", "kp": "N m/rad", "kd": "N m s/rad", "tau": "N m"}
    )
    expected_delay_s = (0.002, 0.003, 0.002)

    def __init__(self, robot: ComposedRobot) -> None:
        self._mjcf, self._joints, self._motors, self.rate_hz = robot.mjcf, robot.joints, robot.motors, robot.policy_hz
        self.centre, stance = np.asarray(robot.stance), np.asarray(robot.stance, np.float32)
        still = np.zeros_like(self.centre)
        self.crouch = _BENT * (np.asarray(self._motors.folded) - self.centre) if self._motors else still
        kp, kd = robot.gains
        self.message: Callable[[Any], LegCommand] = partial(leg_command, kp=kp, kd=kd)
        self.channels = tuple(
            Channel("position", "velocity", 5e-4, 0.03, index=i, label=name, goal="q")
            for i, name in enumerate(self._joints)
        )
        self.at_rest = BodyReading(stance, np.zeros_like(stance), np.array([1.0, 0, 0, 0]), np.zeros(3))
        self.noise = tuple(
            Noise(f"{field}[{i}]", self.units[field], deviation, 0.0, bias)
            for field, (deviation, bias) in robot.noise.items()
            for i in range(len(np.ravel(getattr(self.at_rest, field))))
        )

    def read(self, reading: Reading) -> BodyReading:
        parts = reading.parts
        return BodyReading(reading.position_rad, reading.velocity_rad_s, parts["quaternion"], parts["gyro"])

    def embedded(self, hanging: bool = False) -> Embedded | None:
        motors = self._motors
        return motors.embedded("stand" if hanging else "floor") if motors and motors.embedded else None

    def device(self, port: str, silence_s: float, embedded: bool) -> Device:
        motors = self._motors
        if motors is None:
            raise UsageError(
                f"this robot has no device for port {port!r}",
                hint="sim2real play lets its policy walk on the twin; for hardware, give the robot LegMotors",
            )
        from sim2real.hardware.registry import load_device

        make = load_device(motors.device)
        return make(port, range(len(self._joints)), motors.settings, baud_rate=0, silence_s=silence_s)

    def prepare(self, rig: Rig, settle_s: float) -> None:
        rig.wait_until_still(settle_s, _STILL_RAD_S)

    def begin(self, rig: Rig) -> None:
        """Let the robot stand up.

        Raises:
            SafetyStop: It tips over, or stands in another pose than its stance at the end.
        """
        motion = StandUp()
        if rig.torque_withheld:
            return
        reading, now_ns = rig.measure(), rig.clock.now_ns
        begin_ns = now_ns()
        start = reading.position_rad
        folded = np.asarray(start if self._motors is None else self._motors.folded)
        while (t_s := 1e-9 * (now_ns() - begin_ns)) < motion.duration_s:
            reading = rig.measure()
            if gravity_of(reading.parts["quaternion"])[2] > -0.5:
                raise SafetyStop("the robot tipped over while it stood up", hint="lay it on even ground, legs folded")
            command = leg_command(motion.targets(t_s, start, folded, self.centre), motion.kp, motion.kd)
            table = np.stack([getattr(command, column.name) for column in rig.device.commanded.columns], axis=-1)
            # The gate's time ends at 0, where the graph's time starts.
            rig.command(table, 0.0, t_s - motion.duration_s)
        off = np.abs(reading.position_rad - self.centre)
        if off.max() > 0.5:
            worst = int(off.argmax())
            raise SafetyStop(f"{self._joints[worst]} is {off[worst]:.2g} rad off the stance after standing up")

    def gate(self, limits: GateLimits, device: Device | None = None) -> GateConfig:
        """Return the gate, with a range for each target, and limits of the other columns."""
        if device is None:
            return super().gate(limits)
        import mujoco

        model: Any = mujoco.MjModel.from_xml_path(str(self._mjcf))  # pyright: ignore[reportAttributeAccessIssue]
        ranges = model.jnt_range[-len(self._joints) :]
        columns = [column.name for column in device.commanded.columns]
        low, high = np.zeros((len(ranges), len(columns))), np.zeros((len(ranges), len(columns)))
        for i, name in enumerate(columns):
            most = _LARGEST.get(name, limits.limit)
            low[:, i], high[:, i] = 0.0 if name in ("kp", "kd") else -most, most
            if name == self.command:
                low[:, i], high[:, i] = np.maximum(ranges[:, 0], -most), np.minimum(ranges[:, 1], most)
        gate = limits.gate(np.inf, stale=device.commanded.stale, joints=self._joints)
        slew = [limits.slew_per_s if name == self.command else np.inf for name in columns]
        return replace(gate, limit=(low.tolist(), high.tolist()), slew_per_s=tuple(slew))
