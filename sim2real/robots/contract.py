"""What a robot is for the stages: ``ROBOT = MyRobot()`` in ``pipelines/NAME/robot.py`` is one.

A robot that misses something cannot be made: whatever it lacks is named at once.
"""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.hardware.safety.config import GateLimits
from sim2real.identify.model import IdentifiableModel
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.probe import Probe
from sim2real.robots.roles import ROLES, Roles
from sim2real.train.environment.graph_environment import TrainingTask

if TYPE_CHECKING:
    from sim2real.hardware.emulation.embedded import EmbeddedRobot
    from sim2real.hardware.safety.rig import Rig

Datum = tuple[str, Callable[[Any], bool]]
"""What a robot's datum must be, in words, and the test for it."""


def tuple_of(kind: type) -> Callable[[Any], bool]:
    """Return the test for a tuple of some objects of a kind."""
    return lambda value: isinstance(value, tuple) and bool(value) and all(isinstance(t, kind) for t in value)


def _texts(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(t, str) for pair in value.items() for t in pair)


def positive(value: Any) -> bool:
    """Return whether a value is a finite number above 0."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0


def _roles(value: Any) -> bool:
    return isinstance(value, Roles) and len({value.sensor, value.supervisor, value.actuator, value.world}) == 4


def _joints(value: Any) -> bool:
    return isinstance(value, Mapping) and all(_texts(fields) for fields in value.values())


class RecordedRobot(ABC):
    """A robot that others have recorded: what identification needs of it.

    Data are attributes of the class, or properties.

    Attributes:
        units: Field of a message -> its unit.
        roles: Which node does what.
        profile_rad_s: How fast the actuators' setpoints move to their goals [rad/s]; infinite: at once.
        causes: What may change several parameters at once: name -> parameter -> by how much it moves on its scale when
            what is named grows by a factor of e.
        export_lead_s: What a simulation of ``identified_mjcf`` in C MuJoCo adds to the delay of commands [s], to do
            what the identified graph does.
    """

    units: Mapping[str, str]
    roles: Roles = ROLES
    profile_rad_s: float = math.inf
    export_lead_s: float = 0.0
    causes: Mapping[str, Mapping[str, float]] = MappingProxyType({})

    _DATA: ClassVar[Mapping[str, Datum]] = {
        "units": ("field -> unit, e.g. {'th': 'rad'}", _texts),
        "roles": ("sim2real.robots.roles.Roles with four different names", _roles),
    }

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Make a robot.

        Raises:
            UsageError: Something is missing or of the wrong kind; all of it is named.
        """
        del args, options
        _refuse(cls, cls)
        return super().__new__(cls)

    @abstractmethod
    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""

    def watched(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model with all that may change between deployments; default: what is identified.

        Parameters beyond those, such as what a hand holds, count as known when the robot was identified: their nominal
        values are what they were then.
        """
        return self.identifiable(max_delay_s)

    def identified_mjcf(self, values: Mapping[str, Any]) -> str | None:
        """Return the robot's model with identified values, as MJCF; None: it has none."""
        del values
        return None


class Session(AbstractContextManager["Session"], Protocol):
    """An open robot, as a context manager; leaving it takes the torque off.

    Attributes:
        rig: The servos behind the safety gate.
        embedded: The emulated robot, if the session has one.
    """

    rig: Rig
    embedded: EmbeddedRobot | None


class Robot(RecordedRobot):
    """A robot that can be recorded, trained for and deployed to: what all stages need of it.

    Attributes:
        rate_hz: Rate of the supervisor [Hz].
        command: Field of the actuator's message that is sent to the motors, with one entry per action.
        joints: Joint -> quantity -> field of the sensor's message, for the log; see ``McapRecorder``.
        observation: Terms of the policy's observation, in order.
        action: The policy's actions, in order, with the bounds that the robot bears.
        limits: Name -> limit that a policy is trained for, such as the ends of the joints' goals.
        probe: The steps by which deploy measures the delay; None: it is not measured.
    """

    rate_hz: float
    command: str
    joints: Mapping[str, Mapping[str, str]]
    observation: tuple[ObservationTerm, ...]
    action: tuple[ActionTerm, ...]
    limits: Mapping[str, float] = MappingProxyType({})
    probe: Probe | None = None

    _DATA: ClassVar[Mapping[str, Datum]] = {
        **RecordedRobot._DATA,
        "rate_hz": ("a number above 0 [Hz]", positive),
        "command": ("the name of a field", lambda value: isinstance(value, str) and bool(value)),
        "joints": ("joint -> quantity -> field, e.g. {'hinge': {'position': 'th'}}", _joints),
        "observation": ("a tuple of sim2real.policy.ObservationTerm", tuple_of(ObservationTerm)),
        "action": ("a tuple of sim2real.policy.ActionTerm", tuple_of(ActionTerm)),
    }

    @property
    def observation_size(self) -> int:
        """Number of entries of the policy's observation."""
        return sum(term.size * term.history for term in self.observation)

    @abstractmethod
    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Open the robot, with torque off.

        Args:
            port: Device file of the port, or ``embedded`` for the emulated robot.
            truth_path: File for the emulated robot's true states and latencies.
        """

    @abstractmethod
    def prepare(self, session: Any, settle_s: float) -> None:
        """Bring the robot to rest where the task starts; torque is off afterwards.

        Args:
            settle_s: Longest time to wait for rest, per attempt [s].
        """

    @abstractmethod
    def recording_nodes(self, session: Any, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that sends an excitation signal.

        Args:
            signal: Shape ``(N,)`` or ``(N, actions)``: one command per step.
        """

    def around(self, signal: np.ndarray) -> np.ndarray:
        """Return an excitation ``(N, actions)`` as this robot plays it; default: around 0, as it is."""
        return signal

    def tilt_rad(self, observation: np.ndarray) -> float:
        """Return how far the robot leans, for ``deploy --max-tilt-rad`` [rad]; NaN, the default: it does not see that.

        Args:
            observation: Shape ``(O,)``: what the policy sees.
        """
        del observation
        return math.nan

    @abstractmethod
    def deployment_nodes(self, session: Any, policy: Any, trial: int = 0) -> tuple[dict[str, BaseNode], dict[str, Any]]:
        """Return the graph on hardware that runs a policy, and parameters of its nodes.

        Args:
            policy: What runs the policy: ``reset()`` begins an episode, a call with an observation ``(O,)`` returns the
                action ``(A,)``, both numpy arrays; see ``PolicyNode``.
            trial: Number of the trial. If the task differs between trials, e.g. in its target, the same number stands
                for the same task, on hardware and in simulation.
        """

    @abstractmethod
    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], TrainingTask]:
        """Return the graph in simulation, and the training task.

        Args:
            draws: Samples of some parameters, each of shape ``(K,)``; an episode uses one of the K joint samples in
                place of the values.
            computation: Node -> distribution of its computation delay.
        """

    @abstractmethod
    def simulation_params(self, values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
        """Return the nodes' parameters for an episode in simulation that starts at rest.

        Args:
            trial: Number of the trial, as in ``deployment_nodes``.
        """

    @abstractmethod
    def nominal(self) -> dict[str, float]:
        """Return the data sheet's values of the parameters, without delays."""

    @abstractmethod
    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return figures of how well a deployment went, among them ``success``.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Name -> values ``(N,)``; entries of a vector are named ``name[i]``. Besides the measured fields, one
                value per step of what the supervisor sent, and of ``command``, the command that was sent to the motors.
        """


def checked(found: Any, where: str) -> RecordedRobot:
    """Return what a module calls its robot, once it is known to be one.

    Args:
        found: The module's ``ROBOT``; None where it has none.
        where: The module, for the message.

    Raises:
        UsageError: It is none, or something about it is of the wrong kind; all of it is named.
    """
    if not isinstance(found, RecordedRobot):
        what = f"is {found!r}" if found is not None else "is missing"
        raise UsageError(
            f"ROBOT of {where} {what}: a robot is an object of a class that inherits from "
            "sim2real.robots.contract.Robot, or from RecordedRobot where there are recordings only",
            hint="make functions and constants of the module methods and attributes of such a class, and end with "
            "`ROBOT = MyRobot()`",
        )
    _refuse(type(found), found)
    return found


def _refuse(kind: type[RecordedRobot], owner: Any) -> None:
    """Say all that is missing or of the wrong kind about a class, or about a robot, which has its properties too."""
    said = [f"has no {name}()" for name in sorted(kind.__abstractmethods__)]
    for name, (what, holds) in kind._DATA.items():
        if owner is kind and isinstance(inspect.getattr_static(kind, name, None), property | cached_property):
            continue  # known once there is a robot
        if not hasattr(owner, name):
            said.append(f"has no {name}: {what}")
        elif not holds(value := getattr(owner, name)):
            said.append(f"has {name} = {value!r}, which is not {what}")
    said += [] if owner is kind else _misfits(owner)
    if said:
        base = Robot if issubclass(kind, Robot) else RecordedRobot
        raise UsageError(
            f"robot {kind.__module__}.{kind.__qualname__} is not complete: it " + "; it ".join(said),
            hint=f"sim2real.robots.contract.{base.__name__} says what each of them is",
        )


def _misfits(robot: Any) -> list[str]:
    """Return which methods are none, or do not take what the stages call them with."""
    said = []
    for base in (RecordedRobot, Robot):
        for name, wanted in vars(base).items() if isinstance(robot, base) else ():
            if name.startswith("_") or not inspect.isfunction(wanted):
                continue
            given, expected = getattr(robot, name), list(inspect.signature(wanted).parameters)[1:]
            try:
                inspect.signature(given).bind(*expected)
            except TypeError:
                said.append(f"has {name} = {given!r}, which does not take ({', '.join(expected)})")
    return said
