"""A robot of servos as a model for the identify stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.devices import SimSensor
from sim2real.robots.loop import DelayParams, delay_parameters, recorded_loop

if TYPE_CHECKING:
    from sim2real.robots.loop_robot import LoopRobot


class IdentifiableLoop:
    """Simulates what the sensor measures from recorded commands; an ``identify.model.IdentifiableModel``.

    Args:
        robot: The robot.
        max_delay_s: Upper bound of each of the two delays [s].
    """

    def __init__(self, robot: LoopRobot, max_delay_s: float) -> None:
        self._robot, self.sensor = robot, robot.roles.sensor
        self.parameters = ParameterTable([*robot.dynamics(), *delay_parameters(max_delay_s, robot.roles)])
        self.ahead_s, self.channels = robot.tick_s, robot.channels
        self.given: Mapping[str, Any] = {robot.roles.actuator: robot.message(robot.command)}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.make_world(resumed=True)
        sensor = SimSensor(self.sensor, robot.rate_hz, world)
        return recorded_loop(sensor, robot.sim_actuator(), world, max_delay_s, self.ahead_s, robot.lead_s)

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return the nodes' parameters.

        Args:
            values: Identified parameters by name.
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        late = DelayParams(values["sensor_delay"] + self.ahead_s)
        return {**self._robot.resumed_params(values, start), self.sensor: late}
