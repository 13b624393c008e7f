"""The five parts of a robot: sensor, drive, agent, task and model. Their classes inherit these protocols."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, Self, Unpack

import numpy as np

from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.identify.model import Channel, PlainSimulation
from sim2real.identify.parameters import Parameter
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.completeness import complete
from sim2real.robots.control_loop.hardware import Embedded
from sim2real.robots.control_loop.loop import Draw
from sim2real.robots.control_loop.messages import EpisodeStart
from sim2real.robots.probe import Probe
from sim2real.robots.roles import Roles
from sim2real.training.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree, Scalar

if TYPE_CHECKING:
    import jax

    from sim2real.emulation.process import EmbeddedRobot
    from sim2real.hardware.device import Reading
    from sim2real.hardware.safety.rig import GateConfig, Rig
    from sim2real.robots.gate_limits import GateLimits
    from sim2real.training.environment.graph_environment import TrainingTask


class Session(AbstractContextManager["Session"], Protocol):
    """An open robot, as a context manager; leaving it takes the torque off.

    Attributes:
        embedded: The emulated robot, if the session has one.
    """

    rig: Rig
    embedded: EmbeddedRobot | None


class _Part(Protocol):
    """Base of all parts: it refuses an object of an incomplete class, with the names of the missing methods."""

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Make the part, if its class has all methods."""
        return complete(cls, *args, **options)


class RobotSensor(_Part, Protocol):
    """The measured quantities.

    Attributes:
        channels: The measured quantities of each joint, in the order of the motors.
        joints: Joint -> quantity -> field of the message, for the log; see ``McapRecorder``.
        units: Field of the message -> its unit.
        at_rest: The message of a robot at rest.
    """

    channels: tuple[Channel, ...]
    joints: Mapping[str, Mapping[str, str]]
    units: Mapping[str, str]
    at_rest: PyTree

    @abstractmethod
    def read(self, reading: Reading) -> PyTree:
        """Return the message of a reading."""


class RobotDrive(_Part, Protocol):
    """The commands to the motors, and the session on hardware. Drivers are imported by ``connect``.

    Attributes:
        rate_hz: Rate of sensor, agent and actuator [Hz].
        command: Field of the actuator's message that is sent to the motors, one entry for each action.
        units: Field of the message -> its unit.
        message: Makes the actuator's message from a command ``(actions,)``.
        expected_delay_s: Computation delays of sensor, agent and actuator that phases allow for: a bus transaction, and
            a policy with its thread's wake-up [s].
        probe: The steps by which deploy measures the delay; None: the delay is not measured.
        embedded: The emulated robot, for the port ``embedded``; None: there is none.
        on_feet: Whether a recording begins as the task does, such as by standing up.
    """

    rate_hz: float
    command: str
    units: Mapping[str, str]
    message: Callable[[PyTree], PyTree]
    expected_delay_s: tuple[float, float, float] = (0.002, 0.002, 0.002)
    probe: Probe | None = None
    embedded: Embedded | None = None
    on_feet: bool = False

    @abstractmethod
    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Open the robot, with torque off.

        Args:
            port: Device file of the port, or ``embedded`` for the emulated robot.
            truth_path: File for the emulated robot's true states and latencies.
        """

    def connect_to_record(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Open the robot for a recording, with torque off, such as legs that hang in a stand; default: ``connect``."""
        return self.connect(port, limits, truth_path, seed)

    @abstractmethod
    def prepare(self, session: Session, settle_s: float) -> None:
        """Bring the robot to rest where the task starts; torque is off afterwards.

        Args:
            settle_s: Longest time to wait for rest, for each attempt [s].
        """

    def begin(self, session: Session) -> None:
        """Bring the robot, with torque on, to the start of the task, such as legs to their stance; default: nothing.

        Called before the first step of an episode.
        """

    def gate(self, limits: GateLimits) -> GateConfig:
        """Return the limits of commands and measurements; default: the same for each command."""
        return limits.gate(limits.limit)

    def around(self, signal: np.ndarray) -> np.ndarray:
        """Return the commands ``(N, actions)`` of an excitation; default: the signal itself, around 0."""
        return signal

    def standing(self, duration_s: float) -> np.ndarray | None:
        """Return the excitation ``(N, actions)`` of a robot on its feet; None: it has no feet."""
        del duration_s
        return None

    def approach(self, session: Session, signal: np.ndarray) -> np.ndarray:
        """Return the commands ``(N, actions)`` with which a recording plays an excitation; default: ``around``."""
        del session
        return self.around(signal)

    def measured_start(self, session: Session, start: EpisodeStart) -> EpisodeStart:
        """Return the start of a deployment, from that of its trial; default: unchanged."""
        del session
        return start


class RobotAgent(_Part, Protocol):
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
    limits: Mapping[str, float] = MappingProxyType({})
    units: Mapping[str, str] = MappingProxyType({})
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


class RobotTask(_Part, Protocol):
    """The starts and the rewards of episodes.

    Attributes:
        aim_size: Number of entries of ``EpisodeStart.aim``.
    """

    aim_size: int = 0

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
        del share
        return start

    def judged(self, graph_state: GraphState, roles: Roles) -> PyTree:
        """Return the state that ``reward``, ``success`` and ``terminated`` evaluate; default: the world's."""
        return graph_state.state[roles.world]

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
        import jax.numpy as jnp  # in training alone

        del state
        return jnp.bool_(False)

    @abstractmethod
    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the figures of a deployment, among them ``success``, from 0 to 1.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Name -> values ``(N,)``; entries of a vector are named ``name[i]``. They are the measured fields,
                and the agent's message and ``command``, as sent to the motors, at each step.
        """


class Exported(Protocol):
    """What a model gives to other simulators; default: nothing."""

    def identified_mjcf(self, values: Mapping[str, Scalar]) -> str | None:
        """Return the model with identified values, as MJCF; None: there is none."""
        del values
        return None

    def plain_simulation(self, values: Mapping[str, float]) -> PlainSimulation | None:
        """Return the robot with identified values as a simulation in plain MuJoCo; None: there is none."""
        del values
        return None


class RobotModel(_Part, Exported, Protocol):
    """The robot in simulation, and the parameters that identification estimates.

    Attributes:
        tick_s: The world's period [s].
        lead_s: Time that the world adds to the actuator's delay [s]; see ``ServoWorld.init_delays``.
        watched_terms: Optional terms that may change between deployments.
        profile_rad_s, causes, export_lead_s: See ``RecordedRobot``.
        needs_gpu: Whether a training takes hours without a GPU.
    """

    tick_s: float
    lead_s: float = 0.0
    watched_terms: tuple[str, ...] = ()
    profile_rad_s: float = math.inf
    causes: Mapping[str, Mapping[str, float]] = MappingProxyType({})
    export_lead_s: float = 0.0
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

    def unidentified(self) -> dict[str, float]:
        """Return parameters of training that no log determines, with their nominal values; default: none."""
        return {}

    def true_state(self, state: PyTree) -> PyTree:
        """Return the part of the world's state that a value function may observe in simulation; default: all of it."""
        return state

    def check_task(self, task: TrainingTask) -> None:
        """Raise ``UsageError`` if the world's state lacks a field that the task reads; default: no check."""
        del task


class ConnectedParts(Protocol):
    """The parts of a robot, and the nodes between them; see ``sim2real.robots.contract.Robot``."""

    drive: RobotDrive
    sensor: RobotSensor
    agent: RobotAgent
    task: RobotTask
    model: RobotModel
    roles: Roles

    @property
    def rate_hz(self) -> float:
        """Rate of sensor, agent and actuator [Hz]."""
        ...

    def node_parameters(
        self, values: Mapping[str, Scalar], start: EpisodeStart, policy: PyTree = None
    ) -> dict[str, PyTree]:
        """Return the parameters of all nodes in simulation."""
        ...

    def sim_actuator(self, **options: Unpack[NodeOptions]) -> BaseNode:
        """Return the bus in simulation."""
        ...
