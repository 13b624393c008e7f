"""Sensor and drive of a walking robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.model import Channel
from sim2real.robots.contract import RobotDrive, RobotSensor, Session
from sim2real.robots.control_loop.messages import Goals
from sim2real.robots.walking.messages import BodyReading

if TYPE_CHECKING:
    from sim2real.hardware.device import Reading
    from sim2real.robots.gate_limits import GateLimits


class BodySensor(RobotSensor):
    """Encoders, and the IMU: its orientation and gyro."""

    units = MappingProxyType({"position": "rad", "velocity": "rad/s", "quaternion": "1", "gyro": "rad/s"})

    def __init__(self, joints: Sequence[str], stance: np.ndarray) -> None:
        self.channels = tuple(
            Channel("position", "velocity", 0.002, 0.05, index=i, label=name, goal="goal")
            for i, name in enumerate(joints)
        )
        self.joints = {
            name: {"position": f"position[{i}]", "velocity": f"velocity[{i}]"} for i, name in enumerate(joints)
        }
        self.at_rest = BodyReading(stance, np.zeros_like(stance), np.array([1.0, 0, 0, 0]), np.zeros(3))

    def read(self, reading: Reading) -> BodyReading:
        """Return the message of a reading."""
        parts = reading.parts
        return BodyReading(reading.position_rad, reading.velocity_rad_s, parts["quaternion"], parts["gyro"])


class TargetDrive(RobotDrive):
    """Targets of all joints."""

    command, units, message = "goal", MappingProxyType({"goal": "rad"}), Goals
    expected_delay_s = (0.002, 0.003, 0.002)

    def __init__(self, robot: Any) -> None:
        self.rate_hz = robot.policy_hz

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Refuse: a subclass of the robot makes the drive of a device."""
        raise UsageError(
            f"this robot has no device for port {port!r}",
            hint="sim2real play lets its policy walk on the twin; `make_drive` of the robot returns a device's drive",
        )

    def prepare(self, session: Session, settle_s: float) -> None:
        """Do nothing: the twin starts in its stance."""
