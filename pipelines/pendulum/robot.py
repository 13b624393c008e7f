"""The pendulum's parts for the stages: its graphs in simulation, what to identify, and its task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.graph.delays import DelayDistribution, TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Channel

from . import parameters
from .model import Agent, Command, DelayedWorld, SimActuator, SimSensor

RATE_HZ = 50.0
WORLD_HZ = 100.0
EXPECTED_DELAY_S = {"sensor": 0.002, "agent": 0.002, "actuator": 0.002}
"""Computation delay that phases allow for: a bus transaction, and a policy with its thread's wake-up [s]."""


class IdentifiablePendulum:
    """What the identify stage needs to know: see ``sim2real.identify.problem.IdentifiableModel``."""

    sensor = "sensor"
    channels = (Channel("th", "thdot", position_sigma=0.002, velocity_sigma=0.05),)

    def __init__(self, max_delay_s: float = 0.06) -> None:
        self.parameters: ParameterTable = parameters.table(max_delay_s)
        self.given: Mapping[str, Any] = {"actuator": Command(action="action")}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, with delays of up to ``max_delay_s`` [s] between them."""
        start = max_delay_s / 4
        sensor = SimSensor("sensor", RATE_HZ)
        actuator = SimActuator("actuator", RATE_HZ)
        world = DelayedWorld("world", WORLD_HZ)
        world.connect(actuator, skip=True, delay_dist=TrainableDist.create(start, 0.0, max_delay_s, "zoh_mean"))
        sensor.connect(world, delay_dist=TrainableDist.create(start, 0.0, max_delay_s, "linear"))
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial state ``(th, thdot)``."""
        return parameters.node_params(values, start)


def control_nodes(sensor: BaseNode, agent: BaseNode, actuator: BaseNode) -> dict[str, BaseNode]:
    """Connect the loop that runs on hardware and in simulation alike."""
    agent.connect(sensor, blocking=True)
    actuator.connect(agent, blocking=True)
    return {n.name: n for n in (sensor, agent, actuator)}


def simulated_nodes(
    computation: Mapping[str, DelayDistribution],
    delays: Mapping[str, tuple[float, float, float]] | None = None,
) -> dict[str, BaseNode]:
    """Return the whole loop in simulation, for training and for comparison.

    Args:
        computation: Computation delays by node; the expected ones are those of the hardware's graph.
        delays: ``sensor_delay`` and ``actuator_delay`` as (value, min, max) [s]; None: no delays at all.
    """
    sensor, agent, actuator = (
        cls(n, RATE_HZ, delay=EXPECTED_DELAY_S[n] if delays else 0.0, delay_dist=computation.get(n))
        for cls, n in ((SimSensor, "sensor"), (Agent, "agent"), (SimActuator, "actuator"))
    )
    nodes = control_nodes(sensor, agent, actuator)
    world = DelayedWorld("world", WORLD_HZ)
    to_world = TrainableDist.create(*delays["actuator_delay"], "zoh_mean") if delays else None
    from_world = TrainableDist.create(*delays["sensor_delay"], "linear") if delays else None
    world.connect(actuator, skip=True, delay_dist=to_world)
    # The expected delay stays out of the phases: on the robot nothing waits for the world either.
    sensor.connect(world, skip=True, delay_dist=from_world)
    return {**nodes, "world": world}


def hanging() -> np.ndarray:
    """Return the state at rest: th = pi, thdot = 0."""
    return np.array([np.pi, 0.0])
