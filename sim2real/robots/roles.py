"""Roles of the nodes in a robot's graph: the stages find nodes by role, not by name."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Roles:
    """Names of the nodes that have a part in the loop of a robot.

    Attributes:
        sensor: Measures.
        supervisor: Decides: the policy makes its steps.
        actuator: Sends the commands to the motors.
        world: The robot and its surroundings, in simulation.
    """

    sensor: str = "sensor"
    supervisor: str = "agent"
    actuator: str = "actuator"
    world: str = "world"


ROLES = Roles()
"""The names that nodes have unless a robot gives them others."""
