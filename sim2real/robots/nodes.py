"""The nodes of a robot's loop: sensor and actuator in simulation and on hardware, and the robot's connection.

Imports no MuJoCo, which would take seconds.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np

from sim2real import pytree
from sim2real.artifacts.identification import Noise
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState, Value
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.later import jax, jnp
from sim2real.policy.runner import Runner
from sim2real.robots.agent import AgentParams, PolicyAgent
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, control_nodes
from sim2real.robots.messages import Decision, Goals
from sim2real.types import Array, Key, PyTree
from sim2real.worlds.recorded import DelayParams, delay_of

if TYPE_CHECKING:
    from sim2real.hardware.device import Reading
    from sim2real.hardware.safety.gate import GateLimits
    from sim2real.hardware.safety.rig import Rig
    from sim2real.robots.robot import Robot, RobotDrive


# -- in simulation


class NoiseSizes(NamedTuple):
    """Sizes of a sensor's noise, each of shape ``(noise,)`` in the units of ``Noise``."""

    deviation: Array
    quantum: Array
    bias: Array


@pytree.dataclass
class SensorBias(Base):
    """The constant errors of a simulated sensor's readings in an episode.

    Attributes:
        bias: Shape ``(noise,)``, each in the unit of its noise.
    """

    bias: Array


class SimSensor(BaseNode):
    """The encoders in simulation: passes on the world's message, after the delay in ``DelayParams``.

    Attributes:
        noise: Noise of the readings; empty: none.
    """

    def __init__(self, name: str, rate: float, world: BaseNode, **options: Unpack[NodeOptions]) -> None:
        super().__init__(name, rate, **options)
        self._world = world
        self.noise: tuple[Noise, ...] = ()
        self._sizes: NoiseSizes | None = None

    @property
    def data(self) -> NoiseSizes | None:
        """The sizes of the noise; see ``HoldsData``."""
        if self._sizes is not None or not self.noise:
            return self._sizes
        numbers = np.array([(n.deviation, n.resolution, n.offset) for n in self.noise], np.float32)
        return NoiseSizes(*numbers.T)

    def with_data(self, data: NoiseSizes) -> SimSensor:
        """Return a copy whose noise has other sizes, which may be traced."""
        sensor = copy.copy(self)
        sensor._sizes = data
        return sensor

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> DelayParams:
        return DelayParams()

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        return self._world.init_output(rng, graph_state)

    def init_delays(self, rng: Key | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        return delay_of(self.name, self._world.name, graph_state)

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        if (sizes := self.data) is None:
            return super().init_state(rng, graph_state)
        drawn = jnp.zeros(len(self.noise)) if rng is None else jax.random.normal(rng, (len(self.noise),))
        params = (graph_state or GraphState()).params.get(self.name)
        return SensorBias(_noise_factor(params) * drawn * sizes.bias)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        message = step_state.inputs[self._world.name][-1].data
        return step_state, message if (sizes := self.data) is None else self._noisy(message, step_state, sizes)

    def _noisy(self, message: PyTree, step_state: StepState, sizes: NoiseSizes) -> PyTree:
        if step_state.rng is None:
            raise UsageError(f"sensor {self.name!r} has noise and no random numbers to draw it from")
        # Each step derives another key; the sensor uses its key for nothing else.
        key = jax.random.fold_in(step_state.rng, step_state.seq)
        added = jax.random.normal(key, (len(self.noise),)) * sizes.deviation
        added = _noise_factor(step_state.params) * added + step_state.state.bias
        changed: dict[str, PyTree] = {}
        for noise, error, quantum in zip(self.noise, added, sizes.quantum, strict=True):
            field, index = noise.place
            value = jnp.asarray(changed.get(field, getattr(message, field)))
            entry = (value if index is None else value[index]) + error
            entry = quantum * jnp.round(entry / quantum) if noise.resolution else entry
            changed[field] = entry if index is None else value.at[index].set(entry)
        return message.replace(**changed)


def _noise_factor(params: PyTree) -> PyTree:
    noise = getattr(params, "noise", None)
    return 1.0 if noise is None else noise


class SimActuator(BaseNode):
    """The bus in simulation: passes on the agent's commands.

    The default output, which holds the joints before the first command, is ``start`` of the agent's parameters, or
    zeros.

    Args:
        message: Makes the node's message from a command ``(joints,)``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        joints: int,
        message: Callable[[PyTree], PyTree] = Goals,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._joints, self._message = joints, message

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> DelayParams:
        return DelayParams()

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        start = getattr((graph_state or GraphState()).params.get(AGENT), "start", None)
        return self._message(np.zeros(self._joints, np.float32) if start is None else jnp.asarray(start, jnp.float32))

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        return step_state, self._message(step_state.inputs[AGENT][-1].data.command)


# -- on hardware


class ServoSensor(BaseNode):
    """Reads all motors in one transaction; the message's time stamp is when the read instruction was sent.

    Args:
        message: Makes the node's message from a reading.
        rest: The message of a robot at rest, which is the default output.
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
        return self._rest

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        reading = self._rig.measure()
        ts = max(self.at(reading.transaction.t_sent_ns), float(step_state.ts))
        return step_state.replace(ts=ts), self._message(reading)


class ServoActuator(BaseNode):
    """Sends the agent's commands through the safety gate; its output is the command that was sent.

    Args:
        message: Makes the node's message from a command ``(motors,)``. If the device's commands have columns, the
            message has a field ``(motors,)`` for each column, with its name.
        begin: Brings the robot to the start of the task; called after the torque is on.
    """

    jittable = False

    def __init__(
        self,
        name: str,
        rate: float,
        rig: Rig,
        message: Callable[[np.ndarray], Any],
        begin: Callable[[], None] | None = None,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._rig, self._message, self._begin = rig, message, begin

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        return self._message(np.zeros(len(self._rig.device.motors)))

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        self._rig.start()
        if self._begin is not None:
            self._begin()
            self._rig.hand_over()
        return True

    def stop(self, timeout: float | None = None) -> bool:
        self._rig.stop()
        return True

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Send the newest command.

        Raises:
            SafetyStop: The newest measurement is too old, or the gate stopped the robot.
        """
        self._rig.require_fresh()
        message = step_state.inputs[AGENT]
        now_s = self.now()
        age_s = now_s - float(message.ts_sent[-1]) if int(message.seq[-1]) >= 0 else 0.0
        wanted = np.asarray(message.data.command[-1], np.float64)
        names = [column.name for column in self._rig.device.commanded.columns]
        if not names:
            return step_state, self._message(self._rig.command(wanted, age_s, now_s))
        # With columns, make the message first, and send its fields.
        sent = self._message(wanted)
        table = np.stack([np.asarray(getattr(sent, name), np.float64) for name in names], axis=-1)
        allowed = self._rig.command(table, age_s, now_s)
        return step_state, sent.replace(**{name: allowed[:, i].astype(np.float32) for i, name in enumerate(names)})


class Excitation(BaseNode):
    """Takes the agent's place during a recording: sends an excitation signal.

    Args:
        signal: Shape ``(N, motors)``: one command for each step; after its end, the last command is repeated.

    Raises:
        UsageError: The signal is not finite.
    """

    jittable = False

    def __init__(self, name: str, rate: float, signal: np.ndarray, **options: Unpack[NodeOptions]) -> None:
        super().__init__(name, rate, **options)
        if not np.isfinite(signal).all():
            raise UsageError("the excitation has values that are not finite")
        self._signal = signal

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> Decision:
        return Decision(np.zeros(self._signal.shape[1]))

    def step(self, step_state: StepState) -> tuple[StepState, Decision]:
        return step_state, Decision(self._signal[min(int(step_state.seq), len(self._signal) - 1)])


class PolicyNode(BaseNode):
    """The agent's node on the wall clock; it calls the bundle's runner instead of a policy in JAX.

    Args:
        agent: A ``PolicyAgent`` that is not connected: it makes observations and messages from numpy arrays.
    """

    jittable = False

    def __init__(self, agent: PolicyAgent, runner: Runner) -> None:
        super().__init__(agent.name, agent.rate, delay=agent.delay, delay_dist=agent.delay_dist)
        self._agent, self._runner = agent, runner

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        return in_numpy(self._agent.init_params(rng, graph_state))

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        return in_numpy(self._agent.init_state(rng, graph_state))

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        return in_numpy(self._agent.init_output(rng, graph_state))

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        self._runner.reset()
        return True

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Make a step with the policy's action.

        Raises:
            SafetyStop: An observation or the action is not finite.
        """
        action = self._runner(np.asarray(self._agent.observe(step_state), np.float32))
        return self._agent.act(step_state, action)


def in_numpy(tree: PyTree) -> PyTree:
    """Return a pytree with numpy arrays as leaves: one array of JAX would make all later computations use JAX."""
    return pytree.map(np.asarray, tree)


# -- the robot on hardware, and its graph

_HOLD_S, _HANG_S = 1.0, 20.0
"""Time for which an excitation's last goals are repeated; longest wait for joints at rest before it [s]."""
_STILL_RAD_S = 0.3
"""Speed below which a joint is at rest, above the noise of motors' speeds [rad/s]."""
HOME_RAD_S = 1.0
"""Speed of joints on the way to the first goals of an excitation, or to the rest pose [rad/s]."""


@contextmanager
def connected(
    drive: RobotDrive, port: str, limits: GateLimits, truth_path: Path, seed: int, hanging: bool = False
) -> Iterator[Rig]:
    """Open a robot for the block, with torque off; afterwards the torque is off and the port is closed.

    Args:
        port: Device file of the port, or ``embedded`` for the emulated robot.
        truth_path: File for the emulated robot's true states and latencies.
        seed: Seed of the emulated robot's jitter and faults.
        hanging: Whether the emulated legs hang in a stand, for a recording.

    Raises:
        UsageError: The port is ``embedded``, but the robot has no emulator.
        HardwareLost: The device cannot be opened, or a motor does not answer.
    """
    # Imported late: training also makes robots, and must not import drivers.
    from sim2real.hardware.safety.rig import Rig

    with ExitStack() as stack:
        is_embedded = port == "embedded"
        if is_embedded:
            if (embedded := drive.embedded(hanging)) is None:
                raise UsageError("this robot has no embedded twin", hint="name its port with --port")
            robot = stack.enter_context(embedded.start(truth_path, seed, drive.mounting))
            port = robot.port
            # Wait until the last command, "torque off", has taken effect, so that the truth file has it.
            config = embedded.emulator
            stack.callback(robot.sleep, config.actuation_latency_s + config.actuation_jitter_s + 0.01)
        device = drive.device(port, limits.servo_watchdog_s, is_embedded)
        yield stack.enter_context(Rig(device, drive.gate(limits, device), drive.mounting))


def recording_nodes(robot: Robot, rig: Rig, signal: np.ndarray | None, standing: bool = False) -> dict[str, BaseNode]:
    """Return the graph on hardware that plays an excitation ``(N,)`` or ``(N, actions)``, one row a step.

    Goals begin at the joints' positions. Without an excitation, the graph has only the sensor, and sends no command.

    Args:
        standing: Whether the recording begins like the task, such as by standing up.
    """
    if signal is None:
        return {SENSOR: _sensor(robot, rig)}
    drive = robot.drive
    rows = np.asarray(signal, np.float64).reshape(-1, len(robot.task.action)) + drive.centre
    if not standing and robot.units.get(drive.command) == "rad":
        rows = approached(rows, rig.wait_until_still(_HANG_S, _STILL_RAD_S).position_rad, drive.rate_hz)
    player = Excitation(AGENT, drive.rate_hz, rows, delay=drive.expected_delay_s[1])
    return _on_hardware(robot, rig, player, (lambda: drive.begin(rig)) if standing else None)


def deployment_nodes(
    robot: Robot, rig: Rig, policy: Runner, trial: int = 0
) -> tuple[dict[str, BaseNode], dict[str, PyTree]]:
    """Return the graph on hardware that runs a policy, and the agent's parameters, which start at the robot's pose.

    Args:
        policy: ``reset()`` begins an episode; a call with an observation ``(O,)`` returns the action ``(A,)``.
    """
    drive, measured = robot.drive, np.asarray(rig.measure().position_rad, np.float32)
    start = robot.task.at_rest(trial).replace(position=measured)
    params = {AGENT: in_numpy(AgentParams.of(start))}
    node = PolicyNode(robot.task.make_agent(drive.rate_hz, delay=drive.expected_delay_s[1]), policy)
    return _on_hardware(robot, rig, node, lambda: drive.begin(rig)), params


def approached(goals: np.ndarray, position_rad: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return goals ``(N, joints)`` [rad] that begin at ``position_rad (joints,)`` and approach ``goals`` at 1 rad/s."""
    # Repeat the last goals: joints that began far away may still be on the way to them.
    goals = np.vstack([goals, np.repeat(goals[-1:], round(_HOLD_S * rate_hz), axis=0)])
    offset = position_rad - goals[0]
    covered = np.arange(len(goals))[:, None] * HOME_RAD_S / rate_hz
    return goals + np.sign(offset) * np.maximum(np.abs(offset) - covered, 0.0)


def _on_hardware(robot: Robot, rig: Rig, agent: BaseNode, begin: Callable[[], None] | None) -> dict[str, BaseNode]:
    drive, options = robot.drive, {"begin": begin, "delay": robot.drive.expected_delay_s[2]}
    actuator = ServoActuator(ACTUATOR, drive.rate_hz, rig, drive.message, **options)
    return control_nodes(_sensor(robot, rig), agent, actuator)


def _sensor(robot: Robot, rig: Rig) -> ServoSensor:
    drive = robot.drive
    return ServoSensor(SENSOR, drive.rate_hz, rig, drive.read, drive.at_rest, delay=drive.expected_delay_s[0])
