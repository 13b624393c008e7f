"""The servo for the identify stage: what may be identified, and the graph that predicts the angle."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sim2real.graph.node import BaseNode
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter
from sim2real.robots.identified import LoggedRobot
from sim2real.worlds.recorded import RecordedActuator, RecordedSensor

from .model import Command, Measurement, ServoWorld

_FASTEST_HZ = 300.0
"""Goals came 3.5 to 7 ms apart."""


class ServoOnArm(LoggedRobot):
    """An XL330 that lifts a mass."""

    units = {"position": "rad", "goal": "rad"}
    channels = (Channel("position", None, position_sigma=0.002, velocity_sigma=0.1, goal="goal"),)
    delayed = "goal to angle"
    tick_s = 1 / 1000.0
    burst = 1

    def dynamics(self) -> list[Parameter]:
        linear: Any = "linear"
        gone: Any = {"vanishes": True}
        return [
            Parameter("stall", "N m", 1.0, 0.4, 2.5, about="at full duty, before it saturates", leaf="world.stall"),
            Parameter("back_emf", "N m s/rad", 0.05, 0.01, 0.2, about="back-EMF", leaf="world.back_emf"),
            Parameter("softness", "1/(N m)", 0.8, 0.05, 2.0, linear, about="saturation", leaf="world.softness"),
            Parameter(
                "armature", "kg m^2", 0.0015, 2e-4, 0.01, about="motor behind gears", leaf="world.armature", **gone
            ),
            Parameter(
                "viscous", "N m s/rad", 0.005, 2e-4, 0.05, about="viscous friction", leaf="world.viscous", **gone
            ),
            Parameter("coulomb", "N m", 0.01, 0.001, 0.08, about="friction without load", leaf="world.coulomb", **gone),
            Parameter("gears", "1", 0.15, 0.02, 0.4, linear, about="share of the load that rubs", leaf="world.gears"),
            Parameter("static", "1", 0.05, 0.0, 0.3, linear, about="more of it at rest", leaf="world.static"),
            Parameter("stribeck", "rad/s", 0.1, 0.02, 1.0, about="speed that ends it", leaf="world.stribeck_rad_s"),
            Parameter("released", "1", 0.5, 0.0, 1.0, linear, about="share, torque off", leaf="world.released"),
            Parameter("offset", "rad", 0.0, -0.06, 0.06, linear, "measurement", "encoder", leaf="world.offset"),
        ]

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        released = Command(jnp.float32(0.0), jnp.float32(0.0), jnp.float32(0.0))
        actuator = RecordedActuator("actuator", _FASTEST_HZ, released)
        return RecordedSensor("sensor", 200.0, Measurement), actuator, ServoWorld("world", 1 / self.tick_s)


ROBOT = ServoOnArm()
