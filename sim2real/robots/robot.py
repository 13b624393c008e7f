"""A robot for the stages, on one page: ``ROBOT = MyRobot()`` in ``pipelines/NAME/robot.py``.

A robot that was only recorded is a ``RecordedRobot``: what identification needs. A ``Robot`` has five parts besides: a
sensor, a drive, an agent, a task and a model, and connects them to graphs. Each part inherits its class here; Python
refuses one without the methods that have no default.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, TypeVar, Unpack

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.identification.model import Channel, IdentifiableModel, PlainSimulation, position_of
from sim2real.identification.parameters import Parameter
from sim2real.later import jax, jnp
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.policy.runner import Runner
from sim2real.robots.loop import (
    ACTUATOR,
    AGENT,
    DELAYS,
    SENSOR,
    WORLD,
    DelayParams,
    Draw,
    IdentifiableLoop,
    LoopTask,
    control_nodes,
    delay_bounds,
    simulated_loop,
    split_delay,
    split_drawn_delay,
)
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.nodes import Excitation, PolicyNode, ServoActuator, ServoSensor, SimActuator, SimSensor, in_numpy
from sim2real.robots.probe import Probe
from sim2real.training.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.artifacts.identification import Noise
    from sim2real.emulation.robot import Emulation, VirtualTime
    from sim2real.hardware.device import Device, Reading
    from sim2real.hardware.joint import Joint
    from sim2real.hardware.safety.following import Following
    from sim2real.hardware.safety.gate import GateConfig, GateLimits
    from sim2real.hardware.safety.rig import Rig
    from sim2real.log.importing.mapping import ImportMapping
    from sim2real.stages.config import Defaults

AnyRobot = TypeVar("AnyRobot", bound="RecordedRobot")
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Embedded:
    """An emulated robot, used for the port ``embedded``.

    Attributes:
        plant: Returns its physics: a ``Plant`` or a ``Body`` of ``sim2real.emulation.plant``.
        emulator: Latencies and faults; its seed is replaced by that of the stage.
    """

    plant: Callable[[], Any]
    emulator: Emulation

    def start(self, truth_path: Path, seed: int, joints: Sequence[Joint] = (), zero_rad: float = 0.0) -> VirtualTime:
        """Return the running robot.

        Args:
            truth_path: File for its true states and latencies.
            joints: Its mounted joints, in the order of the plant's ``servo_ids``.
            zero_rad: Reading of an encoder, from count 0, at the device's 0 [rad].
        """
        from sim2real.emulation.plant import MountedPlant

        plant = self.plant()
        if not all(joint.is_plain for joint in joints):
            plant = MountedPlant(plant, joints, zero_rad)
        truth_path.parent.mkdir(parents=True, exist_ok=True)
        return replace(self.emulator, seed=seed).robot(plant, truth_path)


class RobotSensor(ABC):
    """The measured quantities.

    Attributes:
        channels: The measured quantities of each joint, in the order of the motors.
        units: Field of the message -> its unit.
        at_rest: The message of a robot at rest.
        noise: Noise of the readings in training without an identification.
    """

    channels: tuple[Channel, ...]
    units: Mapping[str, str]
    at_rest: PyTree
    noise: tuple[Noise, ...] = ()

    @property
    def joints(self) -> Mapping[str, Mapping[str, str]]:
        """Joint -> quantity -> field of the message, for the log; see ``McapRecorder``."""
        rows = {}
        for c in self.channels:
            index = "" if c.index is None else f"[{c.index}]"
            rows[c.name] = {"position": position_of(c)} | ({"velocity": f"{c.velocity}{index}"} if c.velocity else {})
        return rows

    @abstractmethod
    def read(self, reading: Reading) -> PyTree:
        """Return the message of a reading."""


class RobotDrive(ABC):
    """The commands to the motors, and the device on hardware, whose driver ``device`` imports.

    Attributes:
        rate_hz: Rate of sensor, agent and actuator [Hz].
        command: Field of the actuator's message that is sent to the motors, one entry for each action.
        units: Field of the message -> its unit.
        message: Makes the actuator's message from a command ``(actions,)``.
        expected_delay_s: Computation delays of sensor, agent and actuator that phases allow for: a bus transaction, and
            a policy with its thread's wake-up [s].
        centre: Commands around which an excitation moves, ``(actions,)``.
        probe: The steps by which deploy measures the delay; None: the delay is not measured.
        zero_rad: Reading of the emulated encoders, from count 0, at the device's 0 [rad].
    """

    rate_hz: float
    command: str
    units: Mapping[str, str]
    message: Callable[[PyTree], PyTree]
    expected_delay_s: tuple[float, float, float] = (0.002, 0.002, 0.002)
    centre: np.ndarray | float = 0.0
    probe: Probe | None = None
    zero_rad: float = 0.0

    @abstractmethod
    def device(self, port: str, silence_s: float, embedded: bool) -> Device:
        """Return the device on a port, not opened yet.

        Args:
            silence_s: Longest silence while torque is on [s].
            embedded: Whether it is the emulated robot's.
        """

    @property
    def mounting(self) -> tuple[Joint, ...]:
        """How each motor's joint is mounted; default: as the device measures and commands it."""
        return ()

    def embedded(self, hanging: bool = False) -> Embedded | None:
        """Return the emulated robot, for the port ``embedded``; default: None, there is none.

        Args:
            hanging: Whether a robot on legs hangs in a stand, to be recorded.
        """
        return None

    @contextmanager
    def connect(
        self, port: str, limits: GateLimits, truth_path: Path, seed: int, hanging: bool = False
    ) -> Iterator[Rig]:
        """Open the robot for the block, with torque off; at its end the torque is off and the port is closed.

        Args:
            port: Device file of the port, or ``embedded`` for the emulated robot.
            truth_path: File for the emulated robot's true states and latencies.
            seed: Seed of the emulated robot's jitter and faults.
            hanging: Whether a robot on legs hangs in a stand, to be recorded.

        Raises:
            UsageError: The port is ``embedded``, but the robot has none.
            HardwareLost: The device cannot be opened, or a motor does not answer.
        """
        # Imported here: training also makes robots, and must not import their drivers.
        from sim2real.hardware.safety.rig import Rig

        with ExitStack() as stack:
            is_embedded = port == "embedded"
            if is_embedded:
                if (embedded := self.embedded(hanging)) is None:
                    raise UsageError("this robot has no embedded twin", hint="name its port with --port")
                robot = stack.enter_context(embedded.start(truth_path, seed, self.mounting, self.zero_rad))
                port = robot.port
                # Wait until the last command, torque off, has taken effect, so that it is in the truth file.
                config = embedded.emulator
                lasts_s = config.actuation_latency_s + config.actuation_jitter_s + 0.01
                stack.callback(robot.sleep, lasts_s)
            device = self.device(port, limits.servo_watchdog_s, is_embedded)
            yield stack.enter_context(Rig(device, self.gate(limits, device), self.mounting))

    @abstractmethod
    def prepare(self, rig: Rig, settle_s: float) -> None:
        """Bring the robot to rest where the task starts; torque is off afterwards.

        Args:
            settle_s: Longest time to wait for rest, for each attempt [s].
        """

    def begin(self, rig: Rig) -> None:  # noqa: B027
        """Bring the robot, with torque on, to the start of the task, such as legs to their stance; default: nothing.

        Called before the first step of an episode.
        """

    def gate(self, limits: GateLimits, device: Device | None = None) -> GateConfig:
        """Return the limits of commands and measurements; default: the same for each command.

        Args:
            device: The device, whose commands may have columns; None: the limits of an excitation.
        """
        return limits.gate(limits.limit)

    def standing(self, duration_s: float) -> np.ndarray | None:
        """Return the excitation ``(N, actions)`` of a robot on its feet; None: it has no feet."""
        return None

    def approach(self, rig: Rig, commands: np.ndarray) -> np.ndarray:
        """Return the commands ``(N, actions)`` with a way to the first of them, from where the robot is; default: none.

        Args:
            commands: Those of the excitation.
        """
        return commands


class RobotAgent(ABC):
    """The observation and the action of the policy.

    Attributes:
        observation: Terms of the policy's observation, in order.
        action: The policy's actions, in order, with their bounds.
        limits: Name -> limit that a policy is trained for, such as the ends of the joints' goals.
        units: Field of the agent's message -> its unit, beside the command.
        tilt_rad: Returns the robot's tilt from an observation ``(O,)``, for ``deploy --max-tilt-rad`` [rad];
            None: the robot does not measure that.
    """

    observation: tuple[ObservationTerm, ...]
    action: tuple[ActionTerm, ...]
    limits: Mapping[str, float] = _NOTHING
    units: Mapping[str, str] = _NOTHING
    tilt_rad: Callable[[np.ndarray], float] | None = None

    @property
    def observation_size(self) -> int:
        """Number of entries of the policy's observation."""
        return sum(term.size * term.history for term in self.observation)

    @abstractmethod
    def make(self, rate_hz: float, **options: Unpack[NodeOptions]) -> BaseNode:
        """Return the policy's node, with ``observe`` and ``act``; see ``PolicyNode``."""

    @abstractmethod
    def params(self, start: EpisodeStart, policy: PyTree) -> PyTree:
        """Return the node's parameters for an episode."""


class RobotTask(ABC):
    """The starts and the rewards of episodes."""

    @abstractmethod
    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        """Return parameters by name and a start for a random episode of training.

        Args:
            draw: Draws dynamics and delays: key -> values by name.
        """

    @abstractmethod
    def at_rest(self, trial: int) -> EpisodeStart:
        """Return the start at rest of a trial. The same number gives the same aim, on hardware and in simulation."""

    def moved(self, start: EpisodeStart, position: Array, velocity: Array) -> EpisodeStart:
        """Return a start with an offset of positions ``(channels,)`` [rad] and velocities [rad/s]."""
        return start.replace(position=start.position + position, velocity=start.velocity + velocity)

    def narrowed(self, start: EpisodeStart, share: Array) -> EpisodeStart:
        """Return a start with a share ``()`` of the task's difficulty, for a curriculum; default: all of it."""
        return start

    def judged(self, graph_state: GraphState) -> PyTree:
        """Return the state that ``reward``, ``success`` and ``terminated`` evaluate; default: the world's."""
        return graph_state.state[WORLD]

    @abstractmethod
    def reward(self, state: PyTree, action: jax.Array) -> Rewards:
        """Return the reward of a policy step: a number, or terms by name, which are added up.

        Args:
            action: Shape ``(actions,)``.
        """

    @abstractmethod
    def success(self, state: PyTree) -> jax.Array:
        """Return whether the task is fulfilled, bool."""

    def terminated(self, state: PyTree) -> jax.Array:
        """Return whether the episode ends, such as after a fall, bool; default: never."""
        return jnp.bool_(False)

    @abstractmethod
    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the figures of a deployment, among them ``success``, from 0 to 1.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Name -> values ``(N,)``; entries of a vector are named ``name[i]``. They are the measured fields,
                and the agent's message and ``command``, as sent to the motors, at each step.
        """


class Simulated:
    """What exports and the drift test ask of a robot's model.

    Attributes:
        profile_rad_s: Speed of the actuators' setpoints towards their goals [rad/s]; infinite: at once.
        causes: Causes that change several parameters at once: name -> parameter -> change of the parameter on its scale
            when the cause grows by a factor of e.
        export_lead_s: Time that a simulation of ``identified_mjcf`` in C MuJoCo adds to the delay of commands [s].
    """

    profile_rad_s: float = math.inf
    causes: Mapping[str, Mapping[str, float]] = _NOTHING
    export_lead_s: float = 0.0

    def identified_mjcf(self, values: Mapping[str, Scalar]) -> str | None:
        """Return the model with identified values, as MJCF; None: there is none."""
        return None

    def plain_simulation(self, values: Mapping[str, float]) -> PlainSimulation | None:
        """Return the robot with identified values as a simulation in plain MuJoCo; None: there is none."""
        return None


class RobotModel(Simulated, ABC):
    """The robot in simulation, and the parameters that identification estimates.

    An entry point of the group ``sim2real.worlds`` makes one from a robot, for ``--world NAME``.

    Attributes:
        tick_s: The world's period [s].
        lead_s: Time that the world adds to the actuator's delay [s]; see ``MjxWorld``.
        watched_terms: Optional terms that may change between deployments.
        needs_gpu: Whether a training takes hours without a GPU.
    """

    tick_s: float
    lead_s: float = 0.0
    watched_terms: tuple[str, ...] = ()
    needs_gpu: bool = False

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that may be identified, at nominal values, without delays."""

    @abstractmethod
    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""

    @abstractmethod
    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> PyTree:
        """Return the world's parameters for an episode, from values by name."""

    def for_training(self, values: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> RobotModel:
        """Return the model of a training with values and draws of parameters; default: this one."""
        return self

    def unidentified(self) -> dict[str, float]:
        """Return parameters of training that no log determines, with their nominal values; default: none."""
        return {}

    def true_state(self, state: PyTree) -> PyTree:
        """Return the part of the world's state that a value function may observe in simulation; default: all of it."""
        return state

    def following(self, values: Mapping[str, float]) -> Following | None:
        """Return how joints with identified values follow their commands; None: as the device says."""
        return None


class RecordedRobot(Simulated, ABC):
    """A robot that was recorded: what identification needs.

    Attributes:
        name: Name of its pipeline, which ``load_robot`` sets; of a robot without a folder the name of its class.
        folder: Folder of its pipeline; None: it has none, and no command finds it by its name.
        defaults: Default settings of its stages; None: those of ``sim2real.stages.config.Defaults``.
        mapping: Mapping of its logs of other recorders, if it has no folder; a folder has an ``import.toml``.
        units: Field of a message -> its unit.
    """

    name: str = ""
    folder: Path | None = None
    defaults: Defaults | None = None
    mapping: ImportMapping | None = None
    units: Mapping[str, str]

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__

    def called_like(self, other: RecordedRobot) -> Self:
        """Give this robot the name, the folder and the defaults of another one, and return it."""
        self.name, self.folder, self.defaults, self.mapping = other.name, other.folder, other.defaults, other.mapping
        return self

    @abstractmethod
    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""

    def watched(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model with all parameters that may change between deployments; default: as ``identifiable``.

        Further parameters, such as a payload, have their nominal values at the time of the identification.
        """
        return self.identifiable(max_delay_s)

    def with_optional_terms(self, wanted: str) -> RecordedRobot:
        """Return the robot with further optional terms; default: the robot, which has all of them.

        Args:
            wanted: ``auto``, ``all``, or names separated by commas.
        """
        return self

    def doubts(self, outputs: Mapping[str, PyTree]) -> list[str]:
        """Return sentences on positions of a log that the model cannot have; default: none."""
        return []


class Robot(RecordedRobot):
    """A robot that can be recorded, trained for and deployed to. It has five parts, which its ``__init__`` sets.

    Attributes:
        delay_spread_s: Largest deviation, up or down, of an episode's delay from that of the simulated loop [s].
        tasks: Further tasks by name, each with its agent; see ``with_task``.
    """

    drive: RobotDrive
    sensor: RobotSensor
    agent: RobotAgent
    task: RobotTask
    model: RobotModel
    delay_spread_s: float = 0.002
    tasks: Mapping[str, tuple[RobotAgent, RobotTask]] = _NOTHING

    # -- what its parts say

    @property
    def rate_hz(self) -> float:
        """Rate of sensor, agent and actuator [Hz]."""
        return self.drive.rate_hz

    @property
    def units(self) -> Mapping[str, str]:
        return {**self.sensor.units, **self.drive.units, **self.agent.units}

    @property
    def profile_rad_s(self) -> float:
        return self.model.profile_rad_s

    @property
    def causes(self) -> Mapping[str, Mapping[str, float]]:
        return self.model.causes

    @property
    def export_lead_s(self) -> float:
        return self.model.export_lead_s

    def nominal(self) -> dict[str, float]:
        """Return the nominal values of the model's parameters, without delays."""
        return {p.name: p.nominal for p in self.model.dynamics()}

    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        return IdentifiableLoop(self, max_delay_s)

    def watched(self, max_delay_s: float) -> IdentifiableModel:
        loop = self.identifiable(max_delay_s)
        loop.parameters = loop.parameters.with_terms([*loop.parameters.terms, *self.model.watched_terms])
        return loop

    def in_model(self, model: RobotModel) -> Self:
        """Return the robot in another simulation."""
        moved = copy.copy(self)
        moved.model = model
        return moved

    def with_task(self, name: str) -> Self:
        """Return the robot with another of its tasks, such as ``follow`` of an arm; identifications stay valid.

        Raises:
            UsageError: It has no task of this name.
        """
        if name not in self.tasks:
            raise UsageError(
                f"robot {self.name!r} has no further task {name!r}. Available: {', '.join(self.tasks) or 'none'}"
            )
        robot = copy.copy(self)
        robot.agent, robot.task = self.tasks[name]
        return robot

    def identified_mjcf(self, values: Mapping[str, Scalar]) -> str | None:
        return self.model.identified_mjcf(values)

    def plain_simulation(self, values: Mapping[str, float]) -> PlainSimulation | None:
        return self.model.plain_simulation(values)

    # -- graphs on hardware

    def recording_nodes(self, rig: Rig, signal: np.ndarray | None, standing: bool = False) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays an excitation ``(N,)`` or ``(N, actions)``, one row a step.

        Without an excitation it only measures: it has the sensor alone, and no node sends a command.

        Args:
            standing: Whether it begins as the task does, such as by standing up.
        """
        if signal is None:
            return {SENSOR: self._sensor(rig)}
        drive = self.drive
        rows = np.asarray(signal, np.float64).reshape(-1, len(self.agent.action)) + drive.centre
        rows = rows if standing else drive.approach(rig, rows)
        player = Excitation(AGENT, self.rate_hz, rows, drive.message, delay=drive.expected_delay_s[1])
        return self._on_hardware(rig, player, (lambda: drive.begin(rig)) if standing else None)

    def deployment_nodes(
        self, rig: Rig, policy: Runner, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, PyTree]]:
        """Return the graph on hardware that runs a policy, and the agent's parameters: it starts where the robot is.

        Args:
            policy: ``reset()`` begins an episode; a call with an observation ``(O,)`` returns the action ``(A,)``.
        """
        measured = np.asarray(rig.measure().position_rad, np.float32)
        start = self.task.at_rest(trial).replace(position=measured)
        params = {AGENT: in_numpy(self.agent.params(start, None))}
        node = self.agent.make(self.rate_hz, delay=self.drive.expected_delay_s[1])
        return self._on_hardware(rig, PolicyNode(node, policy), lambda: self.drive.begin(rig)), params

    def _on_hardware(self, rig: Rig, agent: BaseNode, begin: Callable[[], None] | None) -> dict[str, BaseNode]:
        drive, options = self.drive, {"begin": begin, "delay": self.drive.expected_delay_s[2]}
        actuator = ServoActuator(ACTUATOR, self.rate_hz, rig, drive.command, drive.message, **options)
        return control_nodes(self._sensor(rig), agent, actuator)

    def _sensor(self, rig: Rig) -> ServoSensor:
        read, rest, delay_s = self.sensor.read, self.sensor.at_rest, self.drive.expected_delay_s[0]
        return ServoSensor(SENSOR, self.rate_hz, rig, read, rest, delay=delay_s)

    # -- graphs in simulation

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], LoopTask]:
        """Return the graph in simulation, and the training task.

        Args:
            draws: Samples of some parameters, each of shape ``(K,)``; an episode uses one of the K joint samples in
                place of the values.
            computation: Node -> distribution of its computation delay.
            delays: Whether the connections have delays.
        """
        robot, rate = self.in_model(self.model.for_training(values, draws)), self.rate_hz
        tick_s = robot.model.tick_s
        # Share the delays between sensor and actuator as a simulated loop needs, and make room for all draws.
        draws = split_drawn_delay(values, draws, tick_s, self.delay_spread_s)
        values = split_delay(values, tick_s, self.delay_spread_s)
        bounds = delay_bounds(values, tick_s, self.delay_spread_s, robot.model.lead_s, draws) if delays else None
        on_sensor, on_agent, on_actuator = (
            {"delay": delay_s if delays else 0.0, "delay_dist": computation.get(name)}
            for name, delay_s in zip((SENSOR, AGENT, ACTUATOR), self.drive.expected_delay_s, strict=True)
        )
        # Make the nodes and connect them.
        world, agent = robot.model.make_world(), self.agent.make(rate, **on_agent)
        sensor = self.sim_sensor(world, **on_sensor)
        sensor.noise = self.sensor.noise
        nodes = simulated_loop(sensor, agent, self.sim_actuator(**on_actuator), world, bounds)
        return nodes, LoopTask(robot, agent, values, draws)

    def simulation_params(
        self, values: Mapping[str, float], policy: PyTree, trial: int = 0, measured: np.ndarray | None = None
    ) -> dict[str, PyTree]:
        """Return the nodes' parameters for an episode in simulation that starts at rest.

        Args:
            measured: Positions ``(channels,)`` where the robot rested, which may differ from the task's by friction.
        """
        values, start = split_delay(values, self.model.tick_s, self.delay_spread_s), self.task.at_rest(trial)
        if measured is not None:
            offset = measured - np.asarray(start.position)
            angles = [self.sensor.units.get(channel.position) == "rad" for channel in self.sensor.channels]
            # Whole turns of a hinge without range are no offset.
            offset -= np.where(angles, 2 * np.pi * np.round(offset / (2 * np.pi)), 0.0)
            # Not `moved`, which keeps drawn starts within the bounds of goals: a robot may rest beyond them, on a stop.
            start = start.replace(position=start.position + offset)
        return self.node_parameters(values, start, policy)

    def node_parameters(
        self, values: Mapping[str, Scalar], start: EpisodeStart, policy: PyTree = None
    ) -> dict[str, PyTree]:
        """Return the parameters of all nodes in simulation, from values by name and a start."""
        return {
            WORLD: self.model.params(values, start),
            SENSOR: DelayParams(delay=values.get(DELAYS[0])),
            ACTUATOR: DelayParams(delay=values.get(DELAYS[1])),
            AGENT: self.agent.params(start, policy),
        }

    def sim_sensor(self, world: BaseNode, **options: Unpack[NodeOptions]) -> SimSensor:
        """Return the encoders in simulation, without noise."""
        return SimSensor(SENSOR, self.rate_hz, world, **options)

    def sim_actuator(self, **options: Unpack[NodeOptions]) -> SimActuator:
        """Return the bus in simulation."""
        drive = self.drive
        return SimActuator(ACTUATOR, self.rate_hz, len(self.agent.action), drive.command, drive.message, **options)


PARTS: Mapping[str, type] = {
    "sensor": RobotSensor,
    "drive": RobotDrive,
    "agent": RobotAgent,
    "task": RobotTask,
    "model": RobotModel,
}
"""The parts of a ``Robot``: name -> its class."""


def checked(robot: Any, where: str) -> RecordedRobot:
    """Return the robot of a module; refuse an incomplete one with all of its gaps.

    Args:
        robot: The module's ``ROBOT``; None if it has none.
    """
    if not isinstance(robot, RecordedRobot):
        raise UsageError(
            f"ROBOT of {where} is {'missing' if robot is None else repr(robot)}: a robot is an object of a class that "
            "inherits from sim2real.robots.robot.Robot, or from RecordedRobot where there are recordings only",
            hint="write a class with the five parts of a Robot, and end with `ROBOT = MyRobot()`",
        )
    gaps: list[str] = []
    if isinstance(robot, Robot):
        for name, kind in PARTS.items():
            part = getattr(robot, name, None)
            if not isinstance(part, kind):
                gaps.append(f"its {name} is {part!r}, not a {kind.__name__}")
                continue
            gaps += [f"its {name} has no {lacking}" for lacking in _unset(part, kind)]
    if not gaps:
        gaps = [f"it has no {lacking}" for lacking in _unset(robot, RecordedRobot)]
    if gaps:
        kind = type(robot)
        raise UsageError(
            f"robot {kind.__module__}.{kind.__qualname__} is not complete: {'; '.join(gaps)}",
            hint="sim2real.robots.robot describes each attribute",
        )
    return robot


def _unset(owner: object, kind: type) -> list[str]:
    """Return the attributes that a class declares without a default and an object does not have."""
    return [name for name in kind.__annotations__ if name not in vars(kind) and not hasattr(owner, name)]


def in_world(robot: AnyRobot, name: str | None) -> AnyRobot:
    """Return a robot in the world of a name: an installed package provides its model.

    Args:
        name: The world; None: the robot's own.

    Raises:
        UsageError: There is no such world, or the robot cannot use another world.
    """
    if name is None:
        return robot
    if not isinstance(robot, Robot):
        raise UsageError(
            f"{type(robot).__name__} was recorded: it stays in the world of its recordings",
            hint="only robots that inherit from sim2real.robots.robot.Robot can use another world",
        )
    from sim2real.hardware.registry import WORLDS, load_entry

    model = load_entry("world", name, WORLDS, "robots.robot.RobotModel")(robot)
    if not isinstance(model, RobotModel):
        raise UsageError(f"world {name!r} makes a {type(model).__name__}", hint="sim2real.robots.robot.RobotModel")
    if (node := model.make_world().name) != WORLD:
        raise UsageError(f"the node of world {name!r} is called {node!r}", hint=f"robots call it {WORLD!r}")
    return robot.in_model(model)


def as_columns(fields: Mapping[str, PyTree]) -> dict[str, np.ndarray]:
    """Return the fields ``(N, ...)`` as columns ``(N,)``: a vector's entries become ``name[i]``."""
    columns = {}
    for name, values in fields.items():
        flat = np.asarray(values).reshape(len(values), -1)
        columns |= {name if flat.shape[1] == 1 else f"{name}[{i}]": column for i, column in enumerate(flat.T)}
    return columns


def as_sent(robot: Robot, decided: Mapping[str, Any], commanded: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns of the agent's message without its command, and of the command to the motors."""
    field = robot.drive.command
    return as_columns({**{n: v for n, v in decided.items() if n != field}, "command": commanded[field]})
