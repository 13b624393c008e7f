"""A robot of a control loop as a model for the identify stage."""

from collections.abc import Mapping, Sequence

from sim2real import pytree
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import ParameterTable
from sim2real.later import jnp
from sim2real.robots.control_loop.loop import DelayParams, delay_parameters, recorded_loop
from sim2real.robots.control_loop.messages import EpisodeStart
from sim2real.robots.control_loop.simulated_devices import SimSensor
from sim2real.robots.robot_parts import ConnectedParts
from sim2real.types import Array, PyTree, Scalar


class IdentifiableLoop:
    """Simulates the sensor's measurements from recorded commands; an ``identify.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of each of the two delays [s].
    """

    def __init__(self, robot: ConnectedParts, max_delay_s: float) -> None:
        self._robot, self.sensor = robot, robot.roles.sensor
        self.parameters = ParameterTable([*robot.model.dynamics(), *delay_parameters(max_delay_s, robot.roles)])
        self.ahead_s, self.channels = robot.model.tick_s, robot.sensor.channels
        message = robot.sim_actuator().init_output()
        fields = pytree.structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, PyTree] = {robot.roles.actuator: fields}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.model.make_world(resumed=True)
        sensor = SimSensor(self.sensor, robot.rate_hz, world)
        return recorded_loop(sensor, robot.sim_actuator(), world, max_delay_s, self.ahead_s, robot.model.lead_s)

    def reached(self, recordings: Sequence[Episode]) -> Mapping[str, float]:
        """Return an empty dict: there are no limits among the optional terms."""
        del recordings
        return {}

    def params(self, values: Mapping[str, Scalar], start: Array) -> dict[str, PyTree]:
        """Return the nodes' parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        position, velocity = jnp.split(jnp.asarray(start), 2, axis=-1)
        begin = EpisodeStart(position, velocity, jnp.zeros(self._robot.task.aim_size))
        params = self._robot.node_parameters(values, begin)
        del params[self._robot.roles.supervisor]
        return {**params, self.sensor: DelayParams(values["sensor_delay"] + self.ahead_s)}
