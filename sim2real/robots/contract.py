"""A robot for the stages: ``ROBOT = MyRobot()`` in ``pipelines/NAME/robot.py``.

A robot has five parts: a sensor, a drive, an agent, a task and a model. ``Robot`` connects them to graphs. A robot that
was only recorded has none of them: ``RecordedRobot`` lists what identification needs.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, Self, Unpack, runtime_checkable

import numpy as np

from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.identify.model import IdentifiableModel, PlainSimulation
from sim2real.policy.upright import Runner
from sim2real.robots.completeness import complete
from sim2real.robots.control_loop.hardware import Excitation, ServoActuator, ServoSensor
from sim2real.robots.control_loop.identification_model import IdentifiableLoop
from sim2real.robots.control_loop.loop import (
    DELAYS,
    DelayParams,
    control_nodes,
    delay_bounds,
    drawn_in_a_loop,
    in_a_loop,
    simulated_loop,
)
from sim2real.robots.control_loop.messages import EpisodeStart
from sim2real.robots.control_loop.policy_node import PolicyNode, in_numpy
from sim2real.robots.control_loop.simulated_devices import SimActuator, SimSensor
from sim2real.robots.control_loop.training_task import LoopTask
from sim2real.robots.robot_parts import Exported
from sim2real.robots.robot_parts import RobotAgent as RobotAgent
from sim2real.robots.robot_parts import RobotDrive as RobotDrive
from sim2real.robots.robot_parts import RobotModel as RobotModel
from sim2real.robots.robot_parts import RobotSensor as RobotSensor
from sim2real.robots.robot_parts import RobotTask as RobotTask
from sim2real.robots.robot_parts import Session as Session
from sim2real.robots.roles import ROLES, Roles
from sim2real.types import PyTree, Scalar


class Identified(Exported, Protocol):
    """The methods of a ``RecordedRobot`` that its data does not decide: all but the first have a default."""

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Make the robot, if its class has all methods."""
        return complete(cls, *args, **options)

    @abstractmethod
    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""

    def watched(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model with all parameters that may change between deployments; default: as ``identifiable``.

        Further parameters, such as a payload, have their nominal values at the time of the identification.
        """
        return self.identifiable(max_delay_s)

    def doubts(self, outputs: Mapping[str, PyTree]) -> list[str]:
        """Return sentences on positions of a log that the model cannot have; default: none."""
        del outputs
        return []


@runtime_checkable
class RecordedRobot(Identified, Protocol):
    """A robot that was recorded: what identification needs.

    Attributes:
        units: Field of a message -> its unit.
        roles: Names of the nodes.
        profile_rad_s: Speed of the actuators' setpoints towards their goals [rad/s]; infinite: at once.
        causes: Causes that change several parameters at once: name -> parameter -> change of the parameter on its scale
            when the cause grows by a factor of e.
        export_lead_s: Time that a simulation of ``identified_mjcf`` in C MuJoCo adds to the delay of commands [s].
    """

    if TYPE_CHECKING:  # Each is an attribute or a property.

        @property
        def units(self) -> Mapping[str, str]: ...
        @property
        def roles(self) -> Roles: ...
        @property
        def profile_rad_s(self) -> float: ...
        @property
        def export_lead_s(self) -> float: ...
        @property
        def causes(self) -> Mapping[str, Mapping[str, float]]: ...
    else:
        units: Mapping[str, str]
        roles, profile_rad_s, export_lead_s, causes = ROLES, math.inf, 0.0, MappingProxyType({})

    def with_optional_terms(self, wanted: str) -> RecordedRobot:
        """Return the robot with further optional terms; default: the robot, which has all of them.

        Args:
            wanted: ``auto``, ``all``, or names separated by commas.
        """
        del wanted
        return self


class Robot:
    """A robot that can be recorded, trained for and deployed to. It has five parts, which its ``__init__`` sets.

    Attributes:
        delay_spread_s: Largest deviation, up or down, of an episode's delay from that of the simulated loop [s].
    """

    drive: RobotDrive
    sensor: RobotSensor
    agent: RobotAgent
    task: RobotTask
    model: RobotModel
    roles: Roles = ROLES
    delay_spread_s: float = 0.002

    # -- for identification, as of any RecordedRobot

    @property
    def rate_hz(self) -> float:
        """Rate of sensor, agent and actuator [Hz]."""
        return self.drive.rate_hz

    @property
    def units(self) -> Mapping[str, str]:
        """Field of a message -> its unit."""
        return {**self.sensor.units, **self.drive.units, **self.agent.units}

    @property
    def profile_rad_s(self) -> float:
        """Speed of the actuators' setpoints towards their goals [rad/s]."""
        return self.model.profile_rad_s

    @property
    def causes(self) -> Mapping[str, Mapping[str, float]]:
        """Causes that change several parameters at once."""
        return self.model.causes

    @property
    def export_lead_s(self) -> float:
        """Time that C MuJoCo adds to the delay of commands [s]."""
        return self.model.export_lead_s

    def nominal(self) -> dict[str, float]:
        """Return the nominal values of the model's parameters, without delays."""
        return {p.name: p.nominal for p in self.model.dynamics()}

    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
        return IdentifiableLoop(self, max_delay_s)

    def watched(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model with all parameters that may change between deployments."""
        loop = self.identifiable(max_delay_s)
        loop.parameters = loop.parameters.with_terms([*loop.parameters.terms, *self.model.watched_terms])
        return loop

    def with_optional_terms(self, wanted: str) -> Self:
        """Return the robot: its model has all of its optional terms."""
        del wanted
        return self

    def doubts(self, outputs: Mapping[str, PyTree]) -> list[str]:
        """Return sentences on positions of a log that the model cannot have: none."""
        del outputs
        return []

    def identified_mjcf(self, values: Mapping[str, Scalar]) -> str | None:
        """Return the model with identified values, as MJCF; None: there is none."""
        return self.model.identified_mjcf(values)

    def plain_simulation(self, values: Mapping[str, float]) -> PlainSimulation | None:
        """Return the robot with identified values as a simulation in plain MuJoCo; None: there is none."""
        return self.model.plain_simulation(values)

    # -- graphs on hardware

    def recording_nodes(self, session: Session, signal: np.ndarray | None) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays an excitation ``(N,)`` or ``(N, actions)``, one row a step.

        Without an excitation it only measures: it has the sensor alone, and no node sends a command.
        """
        if signal is None:
            return {self.roles.sensor: self._sensor(session)}
        rows = np.asarray(signal, np.float64).reshape(-1, len(self.agent.action))
        drive = self.drive
        rows = drive.around(rows) if drive.on_feet else drive.approach(session, rows)
        delay_s = drive.expected_delay_s[1]
        player = Excitation(self.roles.supervisor, self.rate_hz, rows, drive.message, delay=delay_s)
        return self._on_hardware(session, player, (lambda: drive.begin(session)) if drive.on_feet else None)

    def deployment_nodes(
        self, session: Session, policy: Runner, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, PyTree]]:
        """Return the graph on hardware that runs a policy, and the agent's parameters.

        Args:
            policy: ``reset()`` begins an episode; a call with an observation ``(O,)`` returns the action ``(A,)``.
        """
        start = self.drive.measured_start(session, self.task.at_rest(trial))
        params = {self.roles.supervisor: in_numpy(self.agent.params(start, None))}
        node = self.agent.make(self.rate_hz, delay=self.drive.expected_delay_s[1])
        return self._on_hardware(session, PolicyNode(node, policy), lambda: self.drive.begin(session)), params

    def _on_hardware(
        self, session: Session, agent: BaseNode, begin: Callable[[], None] | None = None
    ) -> dict[str, BaseNode]:
        rate, rig, acting_s = self.rate_hz, session.rig, self.drive.expected_delay_s[2]
        roles, drive = self.roles, self.drive
        actuator = ServoActuator(
            roles.actuator, rate, rig, drive.command, drive.message, roles.supervisor, begin, delay=acting_s
        )
        return control_nodes(self._sensor(session), agent, actuator)

    def _sensor(self, session: Session) -> ServoSensor:
        read, rest, delay_s = self.sensor.read, self.sensor.at_rest, self.drive.expected_delay_s[0]
        return ServoSensor(self.roles.sensor, self.rate_hz, session.rig, read, rest, delay=delay_s)

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
        roles, rate, tick_s = self.roles, self.rate_hz, self.model.tick_s
        # Share the delays between sensor and actuator as a simulated loop needs, and make room for all draws.
        draws = drawn_in_a_loop(values, draws, tick_s, self.delay_spread_s)
        values = in_a_loop(values, tick_s, self.delay_spread_s)
        bounds = delay_bounds(values, tick_s, self.delay_spread_s, self.model.lead_s, draws) if delays else None
        names = (roles.sensor, roles.supervisor, roles.actuator)
        on_sensor, on_agent, on_actuator = (
            {"delay": delay_s if delays else 0.0, "delay_dist": computation.get(name)}
            for name, delay_s in zip(names, self.drive.expected_delay_s, strict=True)
        )
        # Make the nodes and connect them.
        world, agent = self.model.make_world(), self.agent.make(rate, **on_agent)
        sensor = SimSensor(roles.sensor, rate, world, **on_sensor)
        nodes = simulated_loop(sensor, agent, self.sim_actuator(**on_actuator), world, bounds)
        task = LoopTask(self, agent, values, draws)
        self.model.check_task(task)
        return nodes, task

    def simulation_params(
        self, values: Mapping[str, float], policy: PyTree, trial: int = 0, measured: np.ndarray | None = None
    ) -> dict[str, PyTree]:
        """Return the nodes' parameters for an episode in simulation that starts at rest.

        Args:
            measured: Positions ``(channels,)`` where the robot rested, which may differ from the task's by friction.
        """
        values, start = in_a_loop(values, self.model.tick_s, self.delay_spread_s), self.task.at_rest(trial)
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
            self.roles.world: self.model.params(values, start),
            self.roles.sensor: DelayParams(delay=values.get(DELAYS[0])),
            self.roles.actuator: DelayParams(delay=values.get(DELAYS[1])),
            self.roles.supervisor: self.agent.params(start, policy),
        }

    def sim_actuator(self, **options: Unpack[NodeOptions]) -> SimActuator:
        """Return the bus in simulation, with options of ``BaseNode``."""
        name, agent, drive = self.roles.actuator, self.roles.supervisor, self.drive
        actions = len(self.agent.action)
        return SimActuator(name, self.rate_hz, actions, drive.command, drive.message, agent, **options)
