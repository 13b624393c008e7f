"""A robot of servos as a model for the identify stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax

from sim2real.graph.episode import named_leaves
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.robots.control_loop.loop import DelayParams, delay_parameters, recorded_loop
from sim2real.robots.control_loop.simulated_devices import SimSensor
from sim2real.robots.roles import Roles


class LoopModel(Protocol):
    """What identification asks of its robot; see ``LoopRobot``."""

    roles: Roles
    rate_hz: float

    @property
    def tick_s(self) -> float:
        """The world's period [s]."""
        ...

    @property
    def lead_s(self) -> float:
        """Time that the world adds to the actuator's delay [s]."""
        ...

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What is measured of each joint."""
        ...

    def dynamics(self) -> list[Parameter]:
        """Return the parameters of the model that may be identified."""
        ...

    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the world's node."""
        ...

    def sim_actuator(self) -> BaseNode:
        """Return the bus in simulation."""
        ...

    def resumed_params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return parameters of world, sensor and actuator for an episode in the middle of a recording."""
        ...


class IdentifiableLoop:
    """Simulates what the sensor measures from recorded commands; an ``identify.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of each of the two delays [s].
    """

    def __init__(self, robot: LoopModel, max_delay_s: float) -> None:
        self._robot, self.sensor = robot, robot.roles.sensor
        self.parameters = ParameterTable([*robot.dynamics(), *delay_parameters(max_delay_s, robot.roles)])
        self.ahead_s, self.channels = robot.tick_s, robot.channels
        message = robot.sim_actuator().init_output()
        fields = jax.tree_util.tree_structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, Any] = {robot.roles.actuator: fields}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.make_world(resumed=True)
        sensor = SimSensor(self.sensor, robot.rate_hz, world)
        return recorded_loop(sensor, robot.sim_actuator(), world, max_delay_s, self.ahead_s, robot.lead_s)

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return the nodes' parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        late = DelayParams(values["sensor_delay"] + self.ahead_s)
        return {**self._robot.resumed_params(values, start), self.sensor: late}
