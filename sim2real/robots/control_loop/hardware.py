"""The nodes of a servo robot on hardware, and the session that owns port and torque while they run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, Unpack

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.robots.roles import ROLES
from sim2real.types import Key, PyTree

if TYPE_CHECKING:
    from sim2real.emulation.process import EmbeddedRobot, Emulated
    from sim2real.hardware.device import Device, Reading
    from sim2real.hardware.joint import Joint
    from sim2real.hardware.safety.gate import GateConfig
    from sim2real.hardware.safety.rig import Rig


@dataclass(frozen=True)
class Embedded:
    """An emulated robot, used for the port ``embedded``.

    Attributes:
        plant: ``package.module:Name`` or ``path/to/file.py:Name``; see ``load_plant``.
        emulator: Latencies and faults; its seed is replaced by the session's.
        plant_args: Keyword arguments of the plant: JSON-able.
    """

    plant: str
    emulator: Emulated
    plant_args: Mapping[str, Any] = field(default_factory=dict)

    def mounted(self, joints: Sequence[Joint], zero_rad: float) -> Embedded:
        """Return the same robot with its joints mounted; plain joints change nothing.

        Args:
            joints: One for each servo, in the order of the plant's ``servo_ids``.
            zero_rad: Reading of an encoder, from count 0, at the device's 0 [rad].
        """
        if all(joint.is_plain for joint in joints):
            return self
        inside = {"plant": self.plant, "plant_args": dict(self.plant_args)}
        rows = {"joints": [asdict(joint) for joint in joints], "zero_rad": zero_rad}
        return replace(self, plant="sim2real.emulation.plant:MountedPlant", plant_args=inside | rows)


class ServoSession:
    """An open robot: the rig, and, for the port ``embedded``, the process of the emulated robot.

    Args:
        device: Returns the device on a port, not opened yet.
        embedded: The emulated robot; None: there is none.
        truth_path: File for the emulated robot's true states and latencies.
        seed: Seed of the emulated robot's jitter and faults.
        joints: How each motor's joint is mounted; default: as the device measures and commands it.

    Raises:
        UsageError: The port is ``embedded``, but the robot has none.
        HardwareLost: The device cannot be opened, or a motor does not answer.
    """

    def __init__(
        self,
        port: str,
        device: Callable[[str], Device],
        gate: GateConfig,
        embedded: Embedded | None,
        truth_path: Path,
        seed: int,
        joints: Sequence[Joint] = (),
    ) -> None:
        # Imported here: training also makes robots, and must not import their drivers.
        from sim2real.emulation.process import EmbeddedRobot
        from sim2real.hardware.safety.rig import Rig

        self._stack = ExitStack()
        self.embedded: EmbeddedRobot | None = None
        with ExitStack() as opening:
            if port == "embedded":
                if embedded is None:
                    raise UsageError("this robot has no embedded twin", hint="name its port with --port")
                config = replace(embedded.emulator, seed=seed)
                self.embedded = opening.enter_context(
                    EmbeddedRobot(embedded.plant, config, embedded.plant_args, truth_path)
                )
                port = self.embedded.port
                # Wait until the last command, torque off, has taken effect, so that it is in the truth file.
                opening.callback(time.sleep, config.actuation_latency_s + config.actuation_jitter_s + 0.01)
            self.rig = opening.enter_context(Rig(device(port), gate, joints))
            self._stack = opening.pop_all()

    def __enter__(self) -> Self:
        """Return the open robot, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off, close the port, and stop the emulated robot."""
        self._stack.close()


class ServoSensor(BaseNode):
    """Reads all servos in one transaction; the message's time stamp is when the read instruction was sent.

    Args:
        rate: Steps per second [Hz].
        rest: The message of a robot at rest, which is the default output.
        **options: Options of ``BaseNode``.
    """

    jittable = False

    def __init__(
        self,
        name: str,
        rate: float,
        rig: Rig,
        message: Callable[[Reading], Any],
        rest: PyTree,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._rig, self._message, self._rest = rig, message, rest

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the message of a robot at rest."""
        del rng, graph_state
        return self._rest

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Read the servos."""
        reading = self._rig.measure()
        ts = max(self.at(reading.transaction.t_sent_ns), float(step_state.ts))
        return step_state.replace(ts=ts), self._message(reading)


class ServoActuator(BaseNode):
    """Sends the agent's commands through the safety gate; its output is the command that was sent.

    Args:
        rate: Steps per second [Hz].
        field: Field of the agent's message that is the command, shape ``(servos,)``.
        message: Makes the node's message from this command. If the device's commands have columns, it has a field of
            the shape ``(servos,)`` for each, by the column's name.
        begin: Called after the torque is on: brings the robot to the start of the task.
        **options: Options of ``BaseNode``.
    """

    jittable = False

    def __init__(
        self,
        name: str,
        rate: float,
        rig: Rig,
        field: str,
        message: Callable[[np.ndarray], Any],
        agent: str = ROLES.supervisor,
        begin: Callable[[], None] | None = None,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._rig, self._field, self._message, self._agent, self._begin = rig, field, message, agent, begin

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a message with zeros."""
        del rng, graph_state
        return self._message(np.zeros(len(self._rig.device.motors)))

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        """Switch the torque on, and bring the robot to the start of the task."""
        del graph_state, timeout
        self._rig.start()
        if self._begin is not None:
            self._begin()
        return True

    def stop(self, timeout: float | None = None) -> bool:
        """Switch the torque off."""
        del timeout
        self._rig.stop()
        return True

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Send the newest command.

        Raises:
            SafetyStop: The newest measurement is too old, or what the gate stopped.
        """
        self._rig.require_fresh()
        message = step_state.inputs[self._agent]
        now_s = self.now()
        age_s = now_s - float(message.ts_sent[-1]) if int(message.seq[-1]) >= 0 else 0.0
        wanted = np.asarray(getattr(message.data, self._field)[-1], np.float64)
        names = [column.name for column in self._rig.device.commanded.columns]
        if not names:
            return step_state, self._message(self._rig.command(wanted, age_s, now_s))
        # With columns, the message is made first, and its fields are sent.
        sent = self._message(wanted)
        table = np.stack([np.asarray(getattr(sent, name), np.float64) for name in names], axis=-1)
        allowed = self._rig.command(table, age_s, now_s)
        return step_state, sent.replace(**{name: allowed[:, i].astype(np.float32) for i, name in enumerate(names)})


class Excitation(BaseNode):
    """Takes the agent's place during a recording: sends an excitation signal.

    Args:
        rate: Steps per second [Hz].
        signal: Shape ``(N, servos)``: one command a step; after its end the last one again: a goal of 0 may be a leap.
        **options: Options of ``BaseNode``.

    Raises:
        UsageError: The signal is not finite.
    """

    jittable = False

    def __init__(
        self,
        name: str,
        rate: float,
        signal: np.ndarray,
        message: Callable[[np.ndarray], Any],
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        if not np.isfinite(signal).all():
            raise UsageError("the excitation holds values that are no numbers")
        self._signal, self._message = signal, message

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a message with zeros."""
        del rng, graph_state
        return self._message(np.zeros(self._signal.shape[1]))

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Return the next command."""
        row = min(int(step_state.seq), len(self._signal) - 1)
        return step_state, self._message(self._signal[row])
