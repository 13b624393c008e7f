"""The pendulum on a bus: a DYNAMIXEL servo in PWM mode, or the embedded robot that emulates one."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.hardware.bus import BusConfig
from sim2real.hardware.drive import VoltageDrive
from sim2real.hardware.embedded import EmbeddedRobot
from sim2real.hardware.gate import GateConfig
from sim2real.hardware.rig import ServoRig
from sim2real.hardware.wire import EmulatorConfig
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
)
"""Latencies of the embedded robot; the stages never read them, but ``--reveal`` compares with them."""


class Session:
    """An open robot: the rig, and the embedded robot's process where that is what the port names.

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
        self._stack = ExitStack()
        self.embedded: EmbeddedRobot | None = None
        with ExitStack() as opening:
            if port == "embedded":
                config = replace(emulator, seed=seed)
                plant = f"{Path(__file__).with_name('plant.py')}:PendulumPlant"
                self.embedded = opening.enter_context(EmbeddedRobot(plant, config, truth_path=truth_path))
                port = self.embedded.port
                # The last command, torque off, takes its time to the motor; the truth shall show that it came.
                opening.callback(time.sleep, config.actuation_latency_s + config.actuation_jitter_s + 0.01)
            gate = GateConfig(limits.limit, limits.slew_per_s, limits.command_timeout_s, limits.max_speed_rad_s)
            bus = BusConfig(port, BAUD_RATE, watchdog_s=limits.servo_watchdog_s)
            self.rig = opening.enter_context(ServoRig(bus, gate, [SERVO_ID], VoltageDrive(SUPPLY_V)))
            self._stack = opening.pop_all()

    def __enter__(self) -> Self:
        """Return the open robot, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Make safe and close."""
        self._stack.close()


class ServoSensor(BaseNode):
    """Reads angle and velocity; its time stamp is when the reading instruction left."""

    jittable = False

    def __init__(self, name: str, rate: float, rig: ServoRig, **options: Any) -> None:
        super().__init__(name, rate, **options)
        self._rig = rig

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Measurement:
        """Return the pendulum hanging at rest."""
        del rng, graph_state
        return Measurement(th=np.float64(np.pi), thdot=np.float64(0.0))

    def step(self, step_state: StepState) -> tuple[StepState, Measurement]:
        """Measure."""
        reading = self._rig.measure()
        ts = max(self.at(reading.transaction.t_sent_ns), float(step_state.ts))
        message = Measurement(th=reading.position_rad[0] - UPRIGHT_RAD, thdot=reading.velocity_rad_s[0])
        return step_state.replace(ts=ts), message  # pyright: ignore[reportAttributeAccessIssue]


class ServoActuator(BaseNode):
    """Sends the voltage through the safety gate; its output is what was sent."""

    jittable = False

    def __init__(self, name: str, rate: float, rig: ServoRig, **options: Any) -> None:
        super().__init__(name, rate, **options)
        self._rig = rig

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Command:
        """Return zero voltage."""
        del rng, graph_state
        return Command(action=np.zeros(1))

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        """Switch the torque on."""
        del graph_state, timeout
        self._rig.start()
        return True

    def stop(self, timeout: float | None = None) -> bool:
        """Switch the torque off."""
        del timeout
        self._rig.stop()
        return True

    def step(self, step_state: StepState) -> tuple[StepState, Command]:
        """Command."""
        message = step_state.inputs["agent"]
        now_s = self.now()
        age_s = now_s - float(message.ts_sent[-1]) if int(message.seq[-1]) >= 0 else 0.0
        voltage = np.asarray(message.data.action[-1], np.float64)
        return step_state, Command(action=self._rig.command(voltage, age_s, now_s))


class Excitation(BaseNode):
    """The agent's place while recording: plays a signal.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        signal: Shape ``(N,)``: one voltage a step [V]; zero afterwards.
        options: As of ``BaseNode``.
    """

    jittable = False

    def __init__(self, name: str, rate: float, signal: np.ndarray, **options: Any) -> None:
        super().__init__(name, rate, **options)
        if not np.isfinite(signal).all():
            raise UsageError("the excitation holds values that are no numbers")
        self._signal = signal

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Command:
        """Return zero voltage."""
        del rng, graph_state
        return Command(action=np.zeros(1))

    def step(self, step_state: StepState) -> tuple[StepState, Command]:
        """Return the next voltage."""
        seq = int(step_state.seq)
        return step_state, Command(action=np.array([self._signal[seq] if seq < len(self._signal) else 0.0]))
