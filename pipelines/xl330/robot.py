"""The servo for the identify stage: what may be identified, and the graph that predicts the angle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.worlds.recorded import CommandDelay, RecordedActuator

from .model import Command, Sensor, ServoParams, ServoWorld

RATE_HZ, WORLD_HZ = 200.0, 1000.0
_TICK_S = 1 / WORLD_HZ
UNITS = {"position": "rad", "goal": "rad"}
_FASTEST_HZ = 300.0
"""Goals came 3.5 to 7 ms apart."""


def table(max_delay_s: float) -> ParameterTable:
    """Return what may be identified, with a delay of up to ``max_delay_s`` [s]."""
    linear: Any = "linear"
    return ParameterTable(
        [
            Parameter("stall", "N m", 1.0, 0.4, 2.5, about="at full duty, before it saturates", leaf="world.stall"),
            Parameter("back_emf", "N m s/rad", 0.05, 0.01, 0.2, about="back-EMF", leaf="world.back_emf"),
            Parameter("softness", "1/(N m)", 0.8, 0.05, 2.0, linear, about="saturation", leaf="world.softness"),
            Parameter("armature", "kg m^2", 0.0015, 2e-4, 0.01, about="motor behind gears", leaf="world.armature"),
            Parameter("viscous", "N m s/rad", 0.005, 2e-4, 0.05, about="viscous friction", leaf="world.viscous"),
            Parameter("coulomb", "N m", 0.01, 0.001, 0.08, about="friction without load", leaf="world.coulomb"),
            Parameter("gears", "1", 0.15, 0.02, 0.4, linear, about="share of the load that rubs", leaf="world.gears"),
            Parameter("static", "1", 0.05, 0.0, 0.3, linear, about="more of it at rest", leaf="world.static"),
            Parameter("stribeck", "rad/s", 0.1, 0.02, 1.0, about="speed that ends it", leaf="world.stribeck_rad_s"),
            Parameter("released", "1", 0.5, 0.01, 1.0, linear, about="share, torque off", leaf="world.released"),
            Parameter("offset", "rad", 0.0, -0.06, 0.06, linear, "measurement", "encoder", leaf="world.offset"),
            Parameter(
                *("sensor_delay", "s", _TICK_S, 0.0, 2 * _TICK_S, linear, "delay", "the sensor's interpolation"),
                free=False,
                side="measurement",
            ),
            Parameter(
                "delay", "s", 0.0, 0.0, max_delay_s, linear, "delay", "goal to angle", "actuator.delay", side="command"
            ),
        ]
    )


class IdentifiableServo:
    """What the identify stage needs to know: see ``sim2real.identify.model.IdentifiableModel``."""

    sensor = "sensor"
    ahead_s = 0.0
    channels = (Channel("position", None, position_sigma=0.002, velocity_sigma=0.1, goal="goal"),)

    def __init__(self, max_delay_s: float = 0.01) -> None:
        self.parameters = table(max_delay_s)
        self.given: Mapping[str, Any] = {"actuator": Command(goal="goal", kp="kp", enabled="enabled")}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world; the world hears goals up to ``max_delay_s`` [s] late."""
        sensor, actuator = (
            Sensor("sensor", RATE_HZ),
            RecordedActuator("actuator", _FASTEST_HZ, Command(jnp.float32(0.0), jnp.float32(0.0), jnp.float32(0.0))),
        )
        world = ServoWorld("world", WORLD_HZ)
        to_world = TrainableDist.create(max_delay_s / 4, 0.0, max_delay_s, "zoh_mean", burst=1)
        world.connect(actuator, skip=True, delay_dist=to_world)
        # Samples fall between ticks: a tick of delay, for the sensor to interpolate.
        sensor.connect(world, delay_dist=TrainableDist.create(_TICK_S, 0.0, 2 * _TICK_S, "linear"))
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial angle and velocity ``(2,)``."""
        placed = self.parameters.placed({"world": ServoParams(), "actuator": CommandDelay()}, values)
        return {**placed, "world": placed["world"].replace(start=start)}


def identifiable(max_delay_s: float) -> IdentifiableServo:
    """Return the model to identify, with a delay of up to ``max_delay_s`` [s]."""
    return IdentifiableServo(max_delay_s)
