"""A servo robot as a model for the identify stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.devices import SimActuator, SimSensor
from sim2real.robots.loop import DelayParams, delay_parameters, recorded_loop
from sim2real.robots.messages import Goals

if TYPE_CHECKING:
    from sim2real.robots.servo_robot import ServoRobot


class IdentifiableServos:
    """Simulates joint positions and velocities from recorded goals; an ``identify.model.IdentifiableModel``.

    Args:
        robot: The robot.
        max_delay_s: Upper bound of each of the two delays [s].
    """

    sensor = "sensor"

    def __init__(self, robot: ServoRobot, max_delay_s: float) -> None:
        self._robot = robot
        self.parameters = ParameterTable([*robot.dynamics(), *delay_parameters(max_delay_s)])
        self.ahead_s = robot.tick_s
        self.given: Mapping[str, Any] = {"actuator": Goals(goal="goal")}
        sigmas = robot.position_sigma_rad, robot.velocity_sigma_rad_s
        self.channels = tuple(
            Channel("position", "velocity", *sigmas, index=i, label=joint, goal="goal")
            for i, joint in enumerate(robot.servos.joints)
        )

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.make_world(resumed=True)
        sensor = SimSensor("sensor", robot.RATE_HZ, world)
        actuator = SimActuator("actuator", robot.RATE_HZ, len(robot.servos.joints))
        return recorded_loop(sensor, actuator, world, max_delay_s, self.ahead_s, world.lead_s)

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return the nodes' parameters.

        Args:
            values: Identified parameters by name.
            start: Shape ``(2 * joints,)``: initial positions [rad], then velocities [rad/s].
        """
        n = len(self._robot.servos.joints)
        start = jnp.asarray(start)
        params = self._robot.node_params(values, start[:n], start[n:], jnp.zeros(len(self._robot.aim)))
        del params["agent"]
        return {**params, "sensor": DelayParams(values["sensor_delay"] + self.ahead_s)}
