"""Another world for the turntable: its bearing has viscous friction too."""

from __future__ import annotations

from typing import Any

from flax import struct

from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import Parameter
from sim2real.robots.worlds import WorldModel
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


class OiledTable(WorldModel):
    """What the entry point makes, called with the robot."""

    def dynamics(self) -> list[Parameter]:
        """Return the robot's own parameters, and the drag."""
        drag = Parameter("drag", "1/s", 1.0, 0.0, 10.0, "linear", about="viscous friction", leaf="world.drag")
        return [*self.robot.model.dynamics(), drag]

    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the node; all of its state is measured, so a resumed one is no other."""
        return Oiled(self.robot.roles.world, TICK_HZ)
