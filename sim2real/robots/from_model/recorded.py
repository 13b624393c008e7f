"""Robots that are known from recordings: a world that recorded commands drive, and a sensor that reads it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import jax

from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import named_leaves
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.robots.contract import Datum, RecordedRobot, tuple_of
from sim2real.worlds.recorded import RecordedActuator


class LoggedRobot(RecordedRobot):
    """A robot without a device: its nodes and parameters are a subclass's.

    Attributes:
        channels: What was measured of each joint.
        delayed: What happens during the delay that is identified, e.g. ``"goal to angle"``.
        tick_s: The world's period, where samples fall between its ticks: the sensor then needs a tick of delay to
            interpolate. 0 where samples fall on ticks.
        burst: By how many commands a delay's window is longer, for commands that came faster than their rate.
    """

    channels: tuple[Channel, ...]
    delayed: str = "command to measurement"
    tick_s: float = 0.0
    burst: int = 0

    _DATA: ClassVar[Mapping[str, Datum]] = {
        **RecordedRobot._DATA,
        "channels": ("a tuple of sim2real.identify.model.Channel", tuple_of(Channel)),
    }

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that may be identified, but for the delays."""

    @abstractmethod
    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        """Return sensor, actuator and world, not connected yet; their names are those of the roles."""

    def started(self, params: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters with an initial state; default: ``start`` of the world's parameters.

        Args:
            start: Shape ``(2 * channels,)``: measured positions, then velocities.
        """
        world = self.roles.world
        return {**params, world: params[world].replace(start=start)}

    def identifiable(self, max_delay_s: float) -> IdentifiableRecording:
        """Return the model to identify, with a delay of up to ``max_delay_s`` [s]."""
        return IdentifiableRecording(self, max_delay_s)


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
        self.given: Mapping[str, Any] = {actuator: fields}
        self._params = {node.name: node.init_params() for node in nodes}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world; the world hears commands up to ``max_delay_s`` [s] late."""
        sensor, actuator, world = self._robot.make_nodes()
        to_world = TrainableDist.create(max_delay_s / 4, 0.0, max_delay_s, "zoh_mean", burst=self._robot.burst)
        world.connect(actuator, skip=True, delay_dist=to_world)
        tick_s = self._robot.tick_s
        sensor.connect(world, delay_dist=TrainableDist.create(tick_s, 0.0, 2 * tick_s, "linear") if tick_s else None)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        return self._robot.started(self.parameters.placed(self._params, values), start)
