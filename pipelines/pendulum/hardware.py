"""The pendulum on a bus: a DYNAMIXEL servo in PWM mode, or the embedded robot that emulates one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sim2real.hardware.device import Reading
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import VoltageDrive
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.gate import GateConfig
from sim2real.hardware.rig import Rig
from sim2real.robots import hardware
from sim2real.stages.config import GateLimits

from .model import Command, Measurement
from .plant import SUPPLY_V

SERVO_ID = 1
BAUD_RATE = 1_000_000
UPRIGHT_RAD = 0.0
"""What the encoder shows when the pendulum is upright [rad]."""

EMBEDDED = EmulatorConfig(
    baud_rate=BAUD_RATE,
    sensing_latency_s=0.020,
    sensing_jitter_s=0.003,
    actuation_latency_s=0.025,
    actuation_jitter_s=0.004,
    reply_loss=0.002,
    model_number=1190,  # an XL330-M077, for 5 V: when its host dies it goes on turning
)
"""Latencies of the embedded robot; the stages never read them, but ``--reveal`` compares with them."""


class Session(hardware.ServoSession):
    """An open pendulum: the rig, and the embedded robot's process where that is what the port names.

    Args:
        port: A serial port, or ``embedded``.
        limits: The safety gate's limits [V].
        truth_path: Where the embedded robot writes what really happened.
        seed: Of the embedded robot's jitter and losses.
        emulator: How the embedded robot behaves; its own seed does not count.
    """

    def __init__(
        self, port: str, limits: GateLimits, truth_path: Path, seed: int, emulator: EmulatorConfig = EMBEDDED
    ) -> None:
        gate = GateConfig(
            limits.limit,
            limits.slew_per_s,
            limits.command_timeout_s,
            limits.max_speed_rad_s,
            joints=("hinge",),
            stuck_effort=limits.stuck_effort,
        )
        embedded = hardware.Embedded(f"{Path(__file__).with_name('plant.py')}:PendulumPlant", emulator)

        def device(port: str) -> DynamixelServos:
            bus = BusConfig(port, BAUD_RATE, watchdog_s=limits.servo_watchdog_s)
            return DynamixelServos(bus, [SERVO_ID], VoltageDrive(SUPPLY_V))

        super().__init__(port, device, gate, embedded, truth_path, seed)


class ServoSensor(hardware.ServoSensor):
    """Reads angle and velocity; its time stamp is when the reading instruction left.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        rig: The robot.
        **options: As of ``BaseNode``.
    """

    def __init__(self, name: str, rate: float, rig: Rig, **options: Any) -> None:
        hanging = Measurement(th=np.float64(np.pi), thdot=np.float64(0.0))
        super().__init__(name, rate, rig, _measurement, hanging, **options)


class ServoActuator(hardware.ServoActuator):
    """Sends the voltage through the safety gate; its output is what was sent.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        rig: The robot.
        **options: As of ``BaseNode``.
    """

    def __init__(self, name: str, rate: float, rig: Rig, **options: Any) -> None:
        super().__init__(name, rate, rig, "action", Command, **options)


class Excitation(hardware.Excitation):
    """The agent's place while recording: plays a signal.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        signal: Shape ``(N,)``: one voltage a step [V]; zero afterwards.
        **options: As of ``BaseNode``.
    """

    def __init__(self, name: str, rate: float, signal: np.ndarray, **options: Any) -> None:
        super().__init__(name, rate, np.reshape(signal, (-1, 1)), Command, **options)


def _measurement(reading: Reading) -> Measurement:
    return Measurement(th=reading.position_rad[0] - UPRIGHT_RAD, thdot=reading.velocity_rad_s[0])
