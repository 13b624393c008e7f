"""The disk for the identify stage: what may be identified, and how its reading starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from sim2real.graph.node import BaseNode
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter
from sim2real.robots.identified import LoggedRobot
from sim2real.worlds.recorded import Encoder, RecordedActuator, RecordedSensor

from .model import Command, DiskWorld, Measurement


class DiskRobot(LoggedRobot):
    """A motor with an eccentric mass."""

    units = {"th": "rad", "action": "V"}
    # Position: what a local fit leaves is 1.4 mrad; velocity: of a cubic through eight samples.
    channels = (Channel("th", None, position_sigma=0.002, velocity_sigma=0.2),)
    delayed = "command to angle"

    def dynamics(self) -> list[Parameter]:

        def optional(
            name: str, unit: str, nominal: float, low: float, high: float, about: str = "", leaf: str = "", **more: Any
        ) -> Parameter:
            end = {"about": about, "leaf": leaf, "term": name, "off": 0.0, **more}
            return Parameter(name, unit, nominal, low, high, "linear", **end)

        share = "share of the radial load that rubs"
        return [
            Parameter("gain", "rad/s^2/V", 28.0, 5.0, 100.0, about="acceleration per volt", leaf="world.gain"),
            Parameter("gravity", "rad/s^2", 134.0, 40.0, 300.0, about="m g l / J", leaf="world.gravity"),
            Parameter(
                "damping", "1/s", 1.5, 0.1, 6.0, about="with back-EMF", leaf="world.friction.viscous", vanishes=True
            ),
            Parameter("load", "1", 0.047, 0.003, 0.3, about=share, leaf="world.friction.load", term="load", off=0.0),
            optional("swing", "1", 0.05, 0.0, 1.0, about="load by the swing", leaf="world.swing"),
            optional("cogging", "rad/s^2", 0.0, -5.0, 5.0, about="twice a turn", leaf="world.cogging"),
            # Nearly the same as the two before it on these swings: free it and fix cogging to compare.
            optional("voltage_offset", "V", 0.0, -0.3, 0.3, leaf="world.voltage_offset", free=False),
            optional("offset", "rad", 0.0, -0.15, 0.15, "encoder's zero", "sensor.offset", kind="measurement"),
            optional("eccentricity", "rad", 0.0, -0.05, 0.05, "encoder", "sensor.eccentricity", kind="measurement"),
        ]

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        actuator = RecordedActuator("actuator", 40.0, Command(action=jnp.zeros(1)))
        return RecordedSensor("sensor", 40.0, Measurement, Encoder(0.0, 0.0)), actuator, DiskWorld("world", 200.0)

    def started(self, params: Mapping[str, Any], start: Any) -> dict[str, Any]:
        encoder = params["sensor"]
        angle = encoder.angle(start[0])
        return super().started(params, jnp.stack([angle, start[1] / encoder.rate(angle, 1.0)]))


ROBOT = DiskRobot()
