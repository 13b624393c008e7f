"""The families of robots that all tests of safety run on, each with an emulated robot in virtual time."""

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import plants
from turntable import odrive
from turntable.odrive_emulation import ODriveEmulation
from turntable.plant import Turntable

from pipelines.go2.plant import LYING, Go2Body
from sim2real.emulation.bus import BusEmulation, VirtualRobot
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.feetech import StsEmulation
from sim2real.hardware import dynamixel as dynamixel
from sim2real.hardware import feetech as feetech
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import PositionDrive, ServoJoint, VoltageDrive
from sim2real.hardware.device import Device, OperatingMode
from sim2real.hardware.dynamixel import DynamixelServos
from sim2real.hardware.feetech import StsServos
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

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

    def robot(self, plant="", settings=None, truth_path=None, **plant_args: Any) -> Any:
        """Return an emulated robot, on which the torque is off."""
        body = getattr(plants, plant or self.plant)(**{"ids": list(IDS), **plant_args})
        return VirtualRobot(body, self.emulation(**(settings or {})), truth_path)

    def device(self, robot: VirtualRobot, **limits: Any) -> Device:
        return self.make(robot.port, **limits)

    def rig(self, robot: VirtualRobot, gate: Mapping[str, Any] | None = None, **limits: Any) -> Rig:
        return Rig(self.device(robot, **limits), GateConfig(**{**self.gate, **(gate or {})}))

    def on(self, robot: VirtualRobot) -> list[int]:
        """Return the servos whose torque is on now."""
        return [i for i, servo in robot.bus.servos.items() if servo.get(self.torque)]

    def is_safe(self, effects: np.ndarray) -> np.ndarray:
        """Return for each change of a motor whether it is off, or has no voltage."""
        mode, goal = effects["values"][:, :2].T
        return (mode == OperatingMode.OFF) | ((mode == OperatingMode.PWM) & (goal == 0.0))


class _Board(Family):
    """An ODrive, which has no guardian: its own watchdog takes the torque off."""

    def robot(self, plant="", settings=None, truth_path=None, **plant_args: Any) -> Any:
        return VirtualRobot(Turntable(**plant_args), self.emulation(**(settings or {})), truth_path)

    def on(self, robot: VirtualRobot) -> list[int]:
        return [0] if robot.bus.axis.properties[odrive.STATE] == odrive.CLOSED_LOOP else []

    def is_safe(self, effects: np.ndarray) -> np.ndarray:
        mode, goal = effects["values"][:, :2].T
        return (mode == OperatingMode.OFF) | (goal == 0.0)


class _Legs(Family):
    """Legs of a Go2 over DDS, which damp before their torque goes off."""

    def robot(self, plant="stand", settings=None, truth_path=None, **plant_args: Any) -> Any:
        from sim2real.emulation.legs import VirtualLegs

        return VirtualLegs(Go2Body(plant), self.emulation(**(settings or {})), truth_path)

    def on(self, robot: Any) -> list[int]:
        return np.flatnonzero(robot.legs._modes).tolist()

    def is_safe(self, effects: np.ndarray) -> np.ndarray:
        mode, _, kp = effects["values"][:, :3].T
        return (mode == OperatingMode.OFF) | (kp == 0.0)


def _volts(port, **limits):
    return DynamixelServos(BusConfig(port, **limits), IDS, VoltageDrive(5.0))


def _angles(port, **limits):
    return DynamixelServos(BusConfig(port, **limits), IDS, PositionDrive(800, 20.0))


def _sts(port, **limits):
    return StsServos(BusConfig(port, **limits), [ServoJoint(f"joint{i}", i) for i in IDS])


def _board(port, silence_s=0.1):
    return odrive.ODrive(port, (0,), odrive.SpeedLoop(), baud_rate=115_200, silence_s=silence_s)


def _legs(port, **limits):
    from sim2real.hardware.unitree.device import UnitreeLegs
    from sim2real.hardware.unitree.legs import LegDrive

    return UnitreeLegs(port, drive=LegDrive(lie_s=0.2), **limits)


def _standing():
    table = np.tile([0.0, 0.0, 40.0, 1.0, 0.0], (12, 1))
    table[:, 0] = LYING
    return table


def _leg_gate():
    from sim2real.hardware.unitree.device import UnitreeLegs

    device = UnitreeLegs("lo:0")
    low, high = device.reach()
    # After a long wait the legs hang far away from where they are commanded first.
    return {"limit": (low.tolist(), high.tolist()), "stale": device.commanded.stale, "first_step_rad": np.inf}


_ANGLE_GATE = {"limit": 1.0, "slew_per_s": 5.0, "stale": "hold"}
VOLTS = Family(
    "DYNAMIXEL by voltage",
    EmulatorConfig,
    "FirstOrder",
    _volts,
    dynamixel.TORQUE_ENABLE,
    np.full(3, 3.0),
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
SERVOS = (VOLTS, ANGLES, STS)
BOARD = _Board("ODrive", ODriveEmulation, "", _board, None, np.full(1, 4.0), {"limit": 10.0})
LEGS = None
if importlib.util.find_spec("cyclonedds"):
    from sim2real.emulation.legs import UnitreeEmulation

    LEGS = _Legs("Go2", UnitreeEmulation, "", _legs, None, _standing(), _leg_gate())
ROBOTS = (*SERVOS, BOARD, *([LEGS] if LEGS else []))
