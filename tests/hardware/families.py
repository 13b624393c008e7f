"""The families of servos that all tests of safety run on, each with an emulated robot in virtual time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.emulation.bus import BusEmulation
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.virtual import VirtualRobot
from sim2real.hardware.device import Device
from sim2real.hardware.dynamixel import registers as dynamixel
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import PositionDrive, VoltageDrive
from sim2real.hardware.feetech import registers as feetech
from sim2real.hardware.feetech.calibration import CalibratedJoint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

PLANTS = Path(__file__).parent / "plants.py"
IDS = (1, 2, 3)


@dataclass(frozen=True, eq=False)
class Family:
    """Servos of one kind: their emulation, their driver, and a command that moves them."""

    name: str
    emulation: type[BusEmulation]
    plant: str
    make: Callable[..., Device]
    torque: Any
    moving: np.ndarray
    gate: Mapping[str, Any]

    def robot(self, plant: str = "", settings: Mapping[str, Any] | None = None, **plant_args: Any) -> VirtualRobot:
        """Return an emulated robot, on which the torque is off."""
        config = self.emulation(**(settings or {}))
        return VirtualRobot(f"{PLANTS}:{plant or self.plant}", config, {"ids": list(IDS), **plant_args})

    def device(self, robot: VirtualRobot, **limits: Any) -> Device:
        return self.make(robot.port, **limits)

    def rig(self, robot: VirtualRobot, gate: Mapping[str, Any] | None = None, **limits: Any) -> Rig:
        return Rig(self.device(robot, **limits), GateConfig(**{**self.gate, **(gate or {})}))

    def on(self, robot: VirtualRobot) -> list[int]:
        """Return the servos whose torque is on now."""
        return [i for i, servo in robot.bus.servos.items() if servo.get(self.torque)]


def _volts(port, **limits):
    return DynamixelServos(BusConfig(port, **limits), IDS, VoltageDrive(5.0))


def _angles(port, **limits):
    return DynamixelServos(BusConfig(port, **limits), IDS, PositionDrive(p_gain=800, profile_velocity_rad_s=20.0))


def _sts(port, **limits):
    return StsServos(StsConfig(port, **limits), [CalibratedJoint(f"joint{i}", i) for i in IDS])


_ANGLE_GATE = {"limit": 1.0, "slew_per_s": 5.0, "stale": "hold"}
VOLTS = Family(
    "DYNAMIXEL by voltage",
    EmulatorConfig,
    "FirstOrder",
    _volts,
    dynamixel.TORQUE_ENABLE,
    np.full(3, 2.5),
    {"limit": 4.0},
)
ANGLES = Family(
    "DYNAMIXEL by angle",
    EmulatorConfig,
    "Joints",
    _angles,
    dynamixel.TORQUE_ENABLE,
    np.array([0.6, -0.7, 0.4]),
    _ANGLE_GATE,
)
STS = Family("Feetech", StsEmulation, "Joints", _sts, feetech.TORQUE_ENABLE, np.array([0.6, -0.7, 0.4]), _ANGLE_GATE)
FAMILIES = (VOLTS, ANGLES, STS)
