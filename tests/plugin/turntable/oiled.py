"""Another world for the turntable: its bearing has viscous friction too."""

from __future__ import annotations

from typing import Any

from flax import struct

from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.identification.parameters import Parameter
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import Robot, RobotModel
from sim2real.worlds.joint import Forces

from .robot import TICK_HZ, Table, TableParams


@struct.dataclass
class OiledParams(TableParams):
    """The table's parameters, and viscous friction over inertia [1/s]."""

    drag: Any = 0.0


class Oiled(Table):
    """A table whose speed is braked in proportion too."""

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> OiledParams:
        """Return the nominal values."""
        own = super().init_params(rng, graph_state)
        return OiledParams(own.loop, own.friction, own.start, drag=1.0)

    def forces(self, params: OiledParams, position: Any, velocity: Any, command: Any) -> Forces:
        """Return what drives and brakes the table, over its inertia."""
        own = super().forces(params, position, velocity, command)
        return own._replace(damping=own.damping + params.drag)


class OiledTable(RobotModel):
    """What the entry point makes, called with the robot."""

    tick_s = 1 / TICK_HZ

    def __init__(self, robot: Robot) -> None:
        self._own = robot.model

    def dynamics(self) -> list[Parameter]:
        """Return the robot's own parameters, and the drag."""
        return [*self._own.dynamics(), Parameter("drag", "1/s", 1.0, 0.0, 10.0, "linear", about="viscous friction")]

    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the node; all of its state is measured, so a resumed one is no other."""
        return Oiled("world", TICK_HZ)

    def params(self, values: Any, start: EpisodeStart) -> OiledParams:
        """Return the robot's own parameters, and the drag."""
        own = self._own.params(values, start)
        return OiledParams(own.loop, own.friction, own.start, values["drag"])
