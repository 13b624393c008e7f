"""The classes of a robot: ``ROBOT = MyRobot()`` in ``pipelines/NAME/robot.py``.

A robot that was only recorded is a ``RecordedRobot``, which identification needs. A ``Robot`` also has three parts: a
drive, a model and a task. Each part inherits from a class of this module; Python refuses a part that lacks a method
without a default.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, Unpack

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.identification.model import Channel, IdentifiableModel, PlainSimulation, position_of
from sim2real.identification.parameters import Parameter
from sim2real.later import jax
from sim2real.policy.contract import ActionTerm, ObservationTerm, observation_size
from sim2real.robots.agent import PolicyAgent
from sim2real.robots.loop import WORLD, Draw
from sim2real.robots.messages import EpisodeStart, States, Trials
from sim2real.robots.probe import Probe
from sim2real.robots.training import IdentifiableLoop
from sim2real.training.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.artifacts.bundle import Bundle
    from sim2real.artifacts.identification import Noise
    from sim2real.emulation.robot import Emulation, VirtualTime
    from sim2real.hardware.device import Device, Following, Reading
    from sim2real.hardware.joint import Joint
    from sim2real.hardware.safety.gate import GateConfig, GateLimits
    from sim2real.hardware.safety.rig import Rig
    from sim2real.identification.export.targets import Late
    from sim2real.stages.config import Defaults

AnyRobot = TypeVar("AnyRobot", bound="RecordedRobot")
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Embedded:
    """An emulated robot, used for the port ``embedded``.

    Attributes:
        plant: Returns its physics: a ``Plant`` of ``sim2real.emulation.plant``, or a ``LeggedBody``.
        emulator: Latencies and faults; the stage sets its seed.
        zero_rad: Reading of an encoder, from count 0, at the device's 0 [rad].
    """

    plant: Callable[[], Any]
    emulator: Emulation
    zero_rad: float = 0.0

    def start(self, truth_path: Path, seed: int, joints: Sequence[Joint] = ()) -> VirtualTime:
        """Return the running robot.

        Args:
            truth_path: File for its true states and latencies.
            joints: Its mounted joints, in the order of the plant's ``servo_ids``.
        """
        from sim2real.emulation.plant import MountedPlant

        plant = self.plant()
        if not all(joint.is_plain for joint in joints):
            plant = MountedPlant(plant, joints, self.zero_rad)
        truth_path.parent.mkdir(parents=True, exist_ok=True)
        return replace(self.emulator, seed=seed).robot(plant, truth_path)


class RobotDrive(ABC):
    """The motors: what is measured and commanded, and the device on hardware, whose driver ``device`` imports.

    Attributes:
        rate_hz: Rate of sensor, agent and actuator [Hz].
        channels: The measured quantities of each joint, in the order of the motors.
        at_rest: The sensor's message of a robot at rest.
        noise: Noise of the readings in training without an identification.
        command: Field of the actuator's message with the command, one entry for each action.
        message: Makes the actuator's message from a command ``(actions,)``.
        units: Field of the sensor's or actuator's message -> its unit.
        expected_delay_s: Expected computation delays of sensor, agent and actuator [s]: of a bus transaction, and of a
            policy with its thread's wake-up.
        centre: Commands around which an excitation moves, ``(actions,)``.
        probe: The steps by which deploy measures the delay; None: the delay is not measured.
    """

    rate_hz: float
    channels: tuple[Channel, ...]
    at_rest: PyTree
    noise: tuple[Noise, ...] = ()
    command: str
    message: Callable[[PyTree], PyTree]
    units: Mapping[str, str]
    expected_delay_s: tuple[float, float, float] = (0.002, 0.002, 0.002)
    centre: np.ndarray | float = 0.0
    probe: Probe | None = None

    @abstractmethod
    def read(self, reading: Reading) -> PyTree:
        """Return the sensor's message of a reading."""

    @abstractmethod
    def device(self, port: str, silence_s: float, embedded: bool) -> Device:
        """Return the device on a port, not opened yet.

        Args:
            silence_s: Longest silence while torque is on [s].
            embedded: Whether the device is emulated.
        """

    @property
    def mounting(self) -> tuple[Joint, ...]:
        """The mounting of each motor's joint; default: angles and commands are the motors'."""
        return ()

    def embedded(self, hanging: bool = False) -> Embedded | None:
        """Return the emulated robot for the port ``embedded``; default: None, there is none.

        Args:
            hanging: Whether emulated legs hang in a stand, for a recording.
        """
        return None

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


class Judgement(NamedTuple):
    """A task's judgement of the state after a policy step.

    Attributes:
        reward: A number, or terms by name, which are added up.
        success: Whether the task is fulfilled, bool.
        ended: Whether the episode ends, such as after a fall, bool.
    """

    reward: Rewards
    success: jax.Array
    ended: jax.Array | bool = False


class RobotTask(ABC):
    """What a policy sees and does; the starts and the rewards of its episodes.

    Attributes:
        observation: Terms of the policy's observation, in order.
        action: The policy's actions, in order, with their bounds.
        limits: Name -> limit for which a policy is trained, such as the bounds of the joints' goals.
        units: Further field of the agent's message -> its unit.
    """

    observation: tuple[ObservationTerm, ...]
    action: tuple[ActionTerm, ...]
    limits: Mapping[str, float] = _NOTHING
    units: Mapping[str, str] = _NOTHING

    @abstractmethod
    def make_agent(self, rate_hz: float, **options: Unpack[NodeOptions]) -> PolicyAgent:
        """Return the policy's node."""

    @abstractmethod
    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        """Return parameters by name, and the start, of a random episode of training.

        Args:
            draw: Draws dynamics and delays: key -> values by name.
        """

    @abstractmethod
    def at_rest(self, trial: int) -> EpisodeStart:
        """Return the start at rest of a trial; a trial's number gives the same aim on hardware and in simulation."""

    def moved(self, start: EpisodeStart, position: Array, velocity: Array, share: Scalar = 1.0) -> EpisodeStart:
        """Return a start with an offset of positions ``(channels,)`` [rad] and velocities [rad/s].

        Args:
            share: Share ``()`` of the task's difficulty, for a curriculum; default: it changes nothing.
        """
        return start.replace(position=start.position + position, velocity=start.velocity + velocity)

    @abstractmethod
    def judge(self, graph_state: GraphState, action: jax.Array) -> Judgement:
        """Return reward, success and end of a policy step, from the state after it.

        Args:
            action: Shape ``(actions,)``.
        """

    @abstractmethod
    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the figures of a deployment, among them ``success``, from 0 to 1.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Name -> values ``(N,)``; entries of a vector are named ``name[i]``. The names are the measured
                fields, the fields of the agent's message, and ``command``, as sent to the motors.
        """


@dataclass(frozen=True)
class Exported:
    """A robot's model with identified values, for other simulators.

    Attributes:
        mjcf: The model as MJCF.
        late: The timing in C MuJoCo that this text does not hold.
        plain: Returns the model as a simulation in plain MuJoCo.
    """

    mjcf: str
    late: Late
    plain: Callable[[], PlainSimulation]


class RobotModel(ABC):
    """The robot in simulation, and the parameters that identification estimates.

    An entry point of the group ``sim2real.worlds`` makes one from a robot, for ``--world NAME``.

    Attributes:
        tick_s: The world's period [s].
    """

    tick_s: float

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that may be identified, at nominal values, without delays."""

    @abstractmethod
    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording.

        A world's ``lead_s``, if it has one, is added to the actuator's delay [s]. Its ``true_state`` returns what a
        value function may observe of the state in simulation; without it, the whole state. Its ``solve_to_rest`` is
        called for a simulation beside a deployment.
        """

    @abstractmethod
    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> PyTree:
        """Return the world's parameters for an episode, from values by name."""

    def for_training(self, values: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> RobotModel:
        """Return the model for a training with values and samples of parameters; default: this model."""
        return self

    def exported(self, values: Mapping[str, Scalar]) -> Exported | None:
        """Return the model with identified values for other simulators; default: None, no export."""
        return None

    def following(self, values: Mapping[str, float]) -> Following | None:
        """Return how joints with identified values follow their commands; None: by the device's `following`."""
        return None


class RecordedRobot(ABC):
    """A robot that was recorded: what identification needs.

    Attributes:
        name: Name of its pipeline, which ``load_robot`` sets; without a folder, the name of its class.
        folder: Folder of its pipeline; None: there is none, and no command finds the robot by its name.
        defaults: Default settings of its stages; None: those of ``sim2real.stages.config.Defaults``.
        units: Field of a message -> its unit.
    """

    name: str = ""
    folder: Path | None = None
    defaults: Defaults | None = None
    units: Mapping[str, str]

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__

    @abstractmethod
    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""

    def exported(self, values: Mapping[str, Scalar]) -> Exported | None:
        """Return its model with identified values for other simulators; default: None, there is none."""
        return None


class Robot(RecordedRobot):
    """A robot that can be recorded, trained and deployed; its ``__init__`` sets its three parts."""

    drive: RobotDrive
    task: RobotTask
    model: RobotModel
    _world: str | None = None

    @property
    def units(self) -> Mapping[str, str]:
        return {**self.drive.units, "command": self.drive.units[self.drive.command], **self.task.units}

    def nominal(self) -> dict[str, float]:
        """Return the nominal values of the model's parameters, without delays."""
        return {p.name: p.nominal for p in self.model.dynamics()}

    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        return IdentifiableLoop(self, max_delay_s)

    def exported(self, values: Mapping[str, Scalar]) -> Exported | None:
        return self.model.exported(values)

    def simulated(self, bundle: Bundle, trials: Trials) -> list[tuple[States, States]]:
        """Return for each simulation the states of the scored node, and those of the sensor.

        Default: in the compiled graph, from where the robot rested.
        """
        from sim2real.robots.training import simulate
        from sim2real.training.networks.policy import BlendedPolicy, Policy

        policy = Policy.from_weights(bundle.weights, bundle.spec)
        steps = trials.blend_s * bundle.contract.rate_hz
        return simulate(self, BlendedPolicy(policy, steps) if steps else policy, trials)


PARTS: Mapping[str, type] = {
    "drive": RobotDrive,
    "task": RobotTask,
    "model": RobotModel,
}
"""The parts of a ``Robot``: name -> its class."""


def checked(robot: Any, where: str) -> RecordedRobot:
    """Return the robot of a module; the error for an incomplete robot lists all gaps.

    Args:
        robot: The module's ``ROBOT``; None if it has none.
    """
    if not isinstance(robot, RecordedRobot):
        raise UsageError(
            f"ROBOT of {where} is {'missing' if robot is None else repr(robot)}: a robot is an object of a class that "
            "inherits from sim2real.robots.robot.Robot, or from RecordedRobot where there are recordings only",
            hint="write a class with the three parts of a Robot, and end with `ROBOT = MyRobot()`",
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
    """Return the attributes that a class declares without a default, and that an object lacks."""
    return [name for name in kind.__annotations__ if name not in vars(kind) and not hasattr(owner, name)]


PAYLOAD = "payload"
"""Name of a mass in a robot's hand: a parameter, and its optional term."""


def watched(robot: RecordedRobot, max_delay_s: float) -> IdentifiableModel:
    """Return the model to identify, with the payload if it is a term: it may change between deployments."""
    model = robot.identifiable(max_delay_s)
    if isinstance(robot, Robot) and any(p.term == PAYLOAD for p in model.parameters):
        model.parameters = model.parameters.with_terms([*model.parameters.terms, PAYLOAD])
    return model


def in_world(robot: AnyRobot, name: str | None) -> AnyRobot:
    """Return a robot in the world of a name: an installed package provides its model.

    Args:
        name: The world; None: the robot's own. A robot that is in this world already stays as it is.

    Raises:
        UsageError: There is no such world, or the robot cannot use another world.
    """
    if name is None or vars(robot).get("_world") == name:
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
    robot = copy.copy(robot)
    robot.model, robot._world = model, name
    return robot


def channels_of(robot: RecordedRobot) -> tuple[Channel, ...]:
    """Return the measured quantities of each joint: those of the drive, or of the logs."""
    owner: Any = robot.drive if isinstance(robot, Robot) else robot
    return owner.channels


GRAVITY = "gravity in the base's axes"
"""Name of a term of the observation: the direction of gravity ``(3,)``, (0, 0, -1) while the robot is level."""


def tilt_of(observation: Sequence[ObservationTerm]) -> Callable[[np.ndarray], float] | None:
    """Return a function that computes the tilt [rad] from an observation ``(O,)``; None without a term ``GRAVITY``."""
    names = [term.name for term in observation]
    if GRAVITY not in names:
        return None
    down = observation_size(observation[: names.index(GRAVITY)]) + 2
    return lambda observed: float(np.arccos(np.clip(-observed[down], -1.0, 1.0)))


def joint_columns(channels: Sequence[Channel]) -> Mapping[str, Mapping[str, str]]:
    """Return joint -> quantity -> column of the sensor's message, for the log; see ``McapRecorder``."""
    rows = {}
    for c in channels:
        index = "" if c.index is None else f"[{c.index}]"
        rows[c.name] = {"position": position_of(c)} | ({"velocity": f"{c.velocity}{index}"} if c.velocity else {})
    return rows
