"""The disk for the identify stage: what may be identified, and the graph that predicts the angle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.worlds.encoder import Encoder
from sim2real.worlds.recorded import CommandDelay, RecordedActuator

from .model import Command, DiskWorld, Sensor

RATE_HZ, WORLD_HZ = 40.0, 200.0
UNITS = {"th": "rad", "action": "V"}


def table(max_delay_s: float) -> ParameterTable:
    """Return what may be identified, with delays of up to ``max_delay_s`` [s]."""
    linear: Any = "linear"
    share = "share of the radial load that rubs"
    return ParameterTable(
        [
            Parameter("gain", "rad/s^2/V", 28.0, 5.0, 100.0, about="acceleration per volt", leaf="world.gain"),
            Parameter("gravity", "rad/s^2", 134.0, 40.0, 300.0, about="m g l / J", leaf="world.gravity"),
            Parameter("damping", "1/s", 1.5, 0.1, 6.0, about="friction and back-EMF", leaf="world.friction.viscous"),
            Parameter("load", "1", 0.047, 0.003, 0.3, about=share, leaf="world.friction.load"),
            Parameter("swing", "1", 0.05, 0.0, 1.0, linear, about="load by the swing", leaf="world.swing"),
            Parameter("cogging", "rad/s^2", 0.0, -5.0, 5.0, linear, about="twice a turn", leaf="world.cogging"),
            # Nearly the same as the two before it on these swings: free it and fix cogging to compare.
            Parameter("voltage_offset", "V", 0.0, -0.3, 0.3, linear, leaf="world.voltage_offset", free=False),
            Parameter("offset", "rad", 0.0, -0.15, 0.15, linear, "measurement", "encoder's zero", leaf="sensor.offset"),
            Parameter(
                "eccentricity", "rad", 0.0, -0.05, 0.05, linear, "measurement", "encoder", leaf="sensor.eccentricity"
            ),
            Parameter(
                "delay",
                "s",
                0.0,
                0.0,
                max_delay_s,
                linear,
                "delay",
                "command to angle",
                "actuator.delay",
                side="command",
            ),
        ]
    )


class IdentifiableDisk:
    """What the identify stage needs to know: see ``sim2real.identify.model.IdentifiableModel``."""

    sensor = "sensor"
    ahead_s = 0.0
    # Position: what a local fit leaves is 1.4 mrad; velocity: of a cubic through eight samples.
    channels = (Channel("th", None, position_sigma=0.002, velocity_sigma=0.2),)

    def __init__(self, max_delay_s: float = 0.06) -> None:
        self.parameters = table(max_delay_s)
        self.given: Mapping[str, Any] = {"actuator": Command(action="action")}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world; the world hears commands up to ``max_delay_s`` [s] late."""
        sensor, actuator = (
            Sensor("sensor", RATE_HZ),
            RecordedActuator("actuator", RATE_HZ, Command(action=jnp.zeros(1))),
        )
        world = DiskWorld("world", WORLD_HZ)
        to_world = TrainableDist.create(max_delay_s / 4, 0.0, max_delay_s, "zoh_mean")
        world.connect(actuator, skip=True, delay_dist=to_world)
        sensor.connect(world)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial reading and its rate."""
        base = {
            "world": DiskWorld("world", WORLD_HZ).init_params(),
            "sensor": Encoder(),
            "actuator": CommandDelay(),
        }
        placed = self.parameters.placed(base, values)
        encoder = placed["sensor"]
        angle = encoder.angle(start[0])
        velocity = start[1] / encoder.rate(angle, 1.0)
        return {**placed, "world": placed["world"].replace(start=jnp.stack([angle, velocity]))}


def identifiable(max_delay_s: float) -> IdentifiableDisk:
    """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
    return IdentifiableDisk(max_delay_s)
