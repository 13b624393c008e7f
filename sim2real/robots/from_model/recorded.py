"""Robots of recordings: recorded commands drive a world, and a sensor reads it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar

from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.later import jax
from sim2real.robots.completeness import tuple_of
from sim2real.robots.contract import Identified
from sim2real.robots.roles import ROLES, Roles
from sim2real.types import PyTree, Scalar
from sim2real.worlds.recorded import RecordedActuator


class LoggedRobot(Identified):
    """A ``RecordedRobot`` without a device; subclasses define its nodes and parameters.

    Attributes:
        channels: The measured quantities of each joint.
        delayed: The chain with the estimated delay, e.g. ``"goal to angle"``.
        tick_s: The world's period, where samples fall between its ticks: the sensor then needs a tick of delay to
            interpolate. 0 where samples fall on ticks.
        burst: Extra commands in a delay's window, for commands that came faster than their rate.
    """

    units: Mapping[str, str]
    roles: Roles = ROLES
    profile_rad_s: float = math.inf
    export_lead_s: float = 0.0
    causes: Mapping[str, Mapping[str, float]] = MappingProxyType({})
    channels: tuple[Channel, ...]
    delayed: str = "command to measurement"
    tick_s: float = 0.0
    burst: int = 0

    _DATA: ClassVar = {"channels": ("a tuple of sim2real.identify.model.Channel", tuple_of(Channel))}

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that can be identified, without the delays."""

    @abstractmethod
    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        """Return sensor, actuator and world, not connected yet; their names are those of the roles."""

    def started(self, params: Mapping[str, PyTree], start: PyTree) -> dict[str, PyTree]:
        """Return node parameters with an initial state; default: ``start`` of the world's parameters.

        Args:
            start: Shape ``(2 * channels,)``: measured positions, then velocities.
        """
        world = self.roles.world
        return {**params, world: params[world].replace(start=start)}

    def identifiable(self, max_delay_s: float) -> IdentifiableRecording:
        """Return the model to identify, with a delay of up to ``max_delay_s`` [s]."""
        return IdentifiableRecording(self, max_delay_s)

    def with_optional_terms(self, wanted: str) -> LoggedRobot:
        """Return the robot with further optional terms; default: the robot, which has all of them."""
        del wanted
        return self


class IdentifiableRecording:
    """Simulates what the sensor measured from recorded commands; an ``identify.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of the delay [s].
    """

    ahead_s = 0.0

    def __init__(self, robot: LoggedRobot, max_delay_s: float) -> None:
        self._robot, self.sensor, self.channels = robot, robot.roles.sensor, robot.channels
        tick_s, actuator = robot.tick_s, robot.roles.actuator
        held = []
        if tick_s:
            tick = Parameter("sensor_delay", "s", tick_s, 0.0, 2 * tick_s, "linear", "delay")
            held.append(replace(tick, about="the sensor's interpolation", free=False, side="measurement"))
        late = Parameter("delay", "s", 0.0, 0.0, max_delay_s, "linear", "delay", robot.delayed, f"{actuator}.delay")
        self.parameters = ParameterTable([*robot.dynamics(), *held, replace(late, side="command")])
        nodes = robot.make_nodes()
        message = nodes[1].init_output()
        fields = jax.tree_util.tree_structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, PyTree] = {actuator: fields}
        self._params = {node.name: node.init_params() for node in nodes}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world; the world receives commands up to ``max_delay_s`` [s] late."""
        sensor, actuator, world = self._robot.make_nodes()
        to_world = TrainableDist.create(max_delay_s / 4, 0.0, max_delay_s, "zoh_mean", burst=self._robot.burst)
        world.connect(actuator, skip=True, delay_dist=to_world)
        tick_s = self._robot.tick_s
        sensor.connect(world, delay_dist=TrainableDist.create(tick_s, 0.0, 2 * tick_s, "linear") if tick_s else None)
        return {n.name: n for n in (sensor, actuator, world)}

    def reached(self, recordings: Sequence[Episode]) -> Mapping[str, float]:
        """Return an empty dict: there are no limits among the optional terms."""
        del recordings
        return {}

    def params(self, values: Mapping[str, Scalar], start: PyTree) -> dict[str, PyTree]:
        """Return node parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        return self._robot.started(self.parameters.placed(self._params, values), start)
