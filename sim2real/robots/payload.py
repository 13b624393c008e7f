"""What a robot of servos holds in its hand: it is not identified, but tested for when a deployment is judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter
from sim2real.robots.devices import SimActuator
from sim2real.robots.identifiable import IdentifiableLoop
from sim2real.robots.roles import Roles
from sim2real.robots.servo_robot import ServoRobot
from sim2real.robots.simulated import ServoWorld

_MASS, _CENTRE = "mass of the hand", "centre of the hand"


@dataclass(frozen=True)
class Hand:
    """Where a robot holds things.

    Attributes:
        joint: The joint that moves the hand.
        at_m: Where a payload is in the frame of the link that this joint moves [m].
        most_kg: What it can bear.
    """

    joint: str
    at_m: tuple[float, float, float]
    most_kg: float


class Loaded:
    """A robot of servos as ``IdentifiableLoop`` takes it, with one parameter more: a payload, a point mass [kg].

    Its inertia about its own centre is left out: behind gears the rotors' is larger by far.

    Args:
        robot: The robot.
        hand: Where the payload is.
    """

    def __init__(self, robot: ServoRobot, hand: Hand) -> None:
        self._robot, self._hand = robot, hand
        self.roles: Roles = robot.roles
        self.rate_hz, self.tick_s, self.lead_s = robot.rate_hz, robot.tick_s, robot.lead_s
        self.channels: tuple[Channel, ...] = robot.channels
        self._body = robot.task.robot.servos[robot.servos.names.index(hand.joint)].horn.parent
        own = self.make_world().init_params().values
        self._mass, self._centre = own[_MASS][0], own[_CENTRE][0]

    def dynamics(self) -> list[Parameter]:
        """Return the robot's parameters, and the payload: nothing, but for what was identified as part of the robot."""
        least = -0.8 * float(self._mass)
        about = "mass in the hand, beyond that of the model"
        return [
            *self._robot.dynamics(),
            Parameter("payload", "kg", 0.0, least, self._hand.most_kg, "linear", about=about),
        ]

    def make_world(self, resumed: bool = False) -> ServoWorld:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""
        task = self._robot.task
        fields = {_MASS: ([self._body], "mass"), _CENTRE: ([self._body], "ipos"), **self._robot.fields(task)}
        worn = self._robot.servos.sheet.worn
        return ServoWorld(self.roles.world, task, fields, resumed, self.roles.actuator, worn)

    def sim_actuator(self) -> SimActuator:
        """Return the bus in simulation."""
        return self._robot.sim_actuator()

    def resumed_params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return parameters of world, sensor and actuator for an episode in the middle of a recording.

        Args:
            values: Parameters by name.
            start: Shape ``(2 * channels,)``: positions, then velocities.
        """
        params = self._robot.resumed_params(values, start)
        mass = self._mass + values["payload"]
        centre = (self._mass * self._centre + values["payload"] * jnp.asarray(self._hand.at_m)) / mass
        world = params[self.roles.world]
        carried = {_MASS: mass[None], _CENTRE: centre[None]}
        return {**params, self.roles.world: world.replace(values={**world.values, **carried})}


def with_payload(robot: ServoRobot, hand: Hand, max_delay_s: float) -> IdentifiableLoop:
    """Return a robot's model for identification, with the payload in its hand.

    Args:
        robot: The robot.
        hand: Where the payload is.
        max_delay_s: Upper bound of each of the two delays [s].
    """
    return IdentifiableLoop(Loaded(robot, hand), max_delay_s)
