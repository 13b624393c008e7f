"""Robots that were only recorded: recorded commands drive a world, and a sensor reads it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from sim2real import pytree
from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import named_leaves
from sim2real.graph.node import BaseNode
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.robots.loop import ACTUATOR, SENSOR, WORLD
from sim2real.robots.robot import RecordedRobot
from sim2real.types import PyTree, Scalar
from sim2real.worlds.recorded import RecordedActuator

if TYPE_CHECKING:
    from sim2real.log.importing.mapping import ImportMapping


class LoggedRobot(RecordedRobot):
    """A ``RecordedRobot`` without a device; subclasses define its nodes and parameters.

    Attributes:
        channels: The measured quantities of each joint.
        delayed: From where to where the estimated delay counts, e.g. ``"goal to angle"``.
        tick_s: The world's period [s] if samples fall between its ticks: the sensor then needs a tick of delay to
            interpolate. 0 if samples fall on ticks.
        burst: Extra commands in the window of the delay, for commands that came faster than their rate.
        mapping: Mapping for logs of other recorders; default: ``import.toml`` in the robot's folder.
    """

    channels: tuple[Channel, ...]
    delayed: str = "command to measurement"
    tick_s: float = 0.0
    burst: int = 0
    mapping: ImportMapping | None = None

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that can be identified, without the delays."""

    @abstractmethod
    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        """Return sensor, actuator and world, not connected yet."""

    def started(self, params: Mapping[str, PyTree], start: PyTree) -> dict[str, PyTree]:
        """Return node parameters with an initial state; default: ``start`` of the world's parameters.

        Args:
            start: Shape ``(2 * channels,)``: measured positions, then velocities.
        """
        return {**params, WORLD: params[WORLD].replace(start=start)}

    def with_optional_terms(self, wanted: str) -> LoggedRobot:
        """Return the robot with further optional terms; default: the robot itself, which has all terms.

        Args:
            wanted: ``auto``, ``all``, or names separated by commas.
        """
        return self

    def doubts(self, outputs: Mapping[str, PyTree]) -> list[str]:
        """Return sentences on recorded positions that are impossible in the model; default: none."""
        return []

    def identifiable(self, max_delay_s: float) -> IdentifiableRecording:
        return IdentifiableRecording(self, max_delay_s)


class IdentifiableRecording:
    """Simulates what the sensor measured from recorded commands; an ``identification.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of the delay [s].
    """

    ahead_s = 0.0
    sensor = SENSOR

    def __init__(self, robot: LoggedRobot, max_delay_s: float) -> None:
        self._robot, self.channels = robot, robot.channels
        rows, tick_s = robot.dynamics(), robot.tick_s
        if tick_s:
            tick = Parameter("sensor_delay", "s", tick_s, 0.0, 2 * tick_s, "linear", "delay")
            rows.append(replace(tick, about="the sensor's interpolation", free=False, side="measurement"))
        late = Parameter("delay", "s", 0.0, 0.0, max_delay_s, "linear", "delay", robot.delayed, f"{ACTUATOR}.delay")
        self.parameters = ParameterTable([*rows, replace(late, side="command")])
        own = robot.make_nodes()
        message = own[1].init_output()
        fields = pytree.structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, PyTree] = {ACTUATOR: fields}
        self._params = {node.name: node.init_params() for node in own}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world; the world receives commands up to ``max_delay_s`` [s] late."""
        robot = self._robot
        sensor, actuator, world = robot.make_nodes()
        to_world = TrainableDist.create(max_delay_s / 4, 0.0, max_delay_s, "zoh_mean", burst=robot.burst)
        world.connect(actuator, skip=True, delay_dist=to_world)
        tick_s = robot.tick_s
        sensor.connect(world, delay_dist=TrainableDist.create(tick_s, 0.0, 2 * tick_s, "linear") if tick_s else None)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values: Mapping[str, Scalar], start: PyTree) -> dict[str, PyTree]:
        """Return node parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        return self._robot.started(self.parameters.placed(self._params, values), start)
