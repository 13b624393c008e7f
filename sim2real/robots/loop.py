"""The control loop of sensor, agent, actuator and world: how they are connected, and how late messages are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from sim2real.graph.base import Base, GraphState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, Scheduling
from sim2real.identify.parameters import Parameter

BURST = 3
"""After a hiccup of a thread, commands that waited for it leave at once: so many more than the rate explains."""
DELAYS = ("sensor_delay", "actuator_delay")


@struct.dataclass
class DelayParams(Base):
    """The delay of a node's connection with the world [s]; None leaves the connection's own."""

    delay: Any = None


def delay_of(node: str, input_name: str, graph_state: GraphState | None) -> dict[str, Any]:
    """Return the delay of an input [s] as ``init_delays`` does, where a node's ``DelayParams`` set one."""
    delay = getattr((graph_state or GraphState()).params.get(node), "delay", None)
    return {} if delay is None else {input_name: delay}


def delay_parameters(max_delay_s: float) -> list[Parameter]:
    """Return the delays to identify: from the world to the sensor, and from the actuator to the world.

    Args:
        max_delay_s: Upper bound of each [s].
    """
    delay = Parameter("", "s", 0.0, 0.0, max_delay_s, "linear", "delay")
    about = "from motion to measurement's time stamp", "from command's departure to the motor"
    return [
        replace(delay, name=DELAYS[0], about=about[0], leaf="sensor.delay", side="measurement"),
        replace(delay, name=DELAYS[1], about=about[1], leaf="actuator.delay", side="command"),
    ]


def delay_bounds(
    values: Mapping[str, float], tick_s: float, spread_s: float, lead_s: float = 0.0
) -> dict[str, tuple[float, float, float]]:
    """Return each delay with room around it for training: name -> (value, min, max) [s].

    Args:
        values: Both delays by name [s].
        tick_s: The world's period [s]: the sensor interpolates over one.
        spread_s: By how much delays vary between episodes, either way [s].
        lead_s: By how much the world adds to the actuator's delay [s].
    """
    room = tick_s + spread_s
    added = dict(zip(DELAYS, (0.0, lead_s), strict=True))
    return {n: (values[n] + lead, max(0.0, values[n] - room), values[n] + spread_s + lead) for n, lead in added.items()}


def in_a_loop(values: Mapping[str, float], tick_s: float, spread_s: float) -> dict[str, float]:
    """Return parameters whose delays a closed loop can simulate: as much as it needs of them moves to the sensor.

    The sensor interpolates between ticks of the world, and what comes within the next tick is not simulated yet. Where
    in the loop a delay is makes no difference to what a policy sees of its commands.

    Args:
        values: Parameters by name, both delays among them or none [s].
        tick_s: The world's period [s].
        spread_s: By how much delays vary between episodes, either way [s].
    """
    if not set(DELAYS) <= set(values):
        return dict(values)
    total = values[DELAYS[0]] + values[DELAYS[1]]
    sensor = min(max(values[DELAYS[0]], tick_s + spread_s), total)
    return {**values, DELAYS[0]: sensor, DELAYS[1]: total - sensor}


def control_nodes(sensor: BaseNode, agent: BaseNode, actuator: BaseNode) -> dict[str, BaseNode]:
    """Connect the loop that runs on hardware and in simulation alike.

    Whoever waits for another catches up after a hiccup: agent and actuator make up for the steps that they missed, back
    to back, and return to their grid (``Scheduling.PHASE``). With ``FREQUENCY`` one step of 100 ms would move their
    schedules for good, and every later action would be made of data that is 80 ms old while newer messages wait. The
    sensor sets the pace and keeps its frequency: nobody waits in front of it, so what it sends is never old, and no
    two samples lie closer together than its period. As long as no step overruns, both rules are one and the same.
    """
    agent.connect(sensor, blocking=True)
    actuator.connect(agent, blocking=True)
    agent.scheduling = actuator.scheduling = Scheduling.PHASE
    return {n.name: n for n in (sensor, agent, actuator)}


def simulated_loop(
    sensor: BaseNode,
    agent: BaseNode,
    actuator: BaseNode,
    world: BaseNode,
    delays: Mapping[str, tuple[float, float, float]] | None,
) -> dict[str, BaseNode]:
    """Connect the whole loop in simulation, for training and for comparison.

    Args:
        sensor: Reads the world.
        agent: Decides.
        actuator: Drives the world.
        world: The robot and what surrounds it.
        delays: As of ``delay_bounds``; None: no delays at all.
    """
    nodes = control_nodes(sensor, agent, actuator)
    to_world = TrainableDist.create(*delays[DELAYS[1]], "zoh_mean", BURST) if delays else None
    from_world = TrainableDist.create(*delays[DELAYS[0]], "linear") if delays else None
    world.connect(actuator, skip=True, delay_dist=to_world)
    # The expected delay stays out of the phases: on the robot nothing waits for the world either.
    sensor.connect(world, skip=True, delay_dist=from_world)
    return {**nodes, world.name: world}


def recorded_loop(
    sensor: BaseNode, actuator: BaseNode, world: BaseNode, max_delay_s: float, ahead_s: float, lead_s: float = 0.0
) -> dict[str, BaseNode]:
    """Connect what identification simulates: recorded commands in, measurements out.

    Args:
        sensor: Reads the world.
        actuator: What it sent was recorded.
        world: The robot and what surrounds it.
        max_delay_s: Upper bound of the delays [s].
        ahead_s: By how much later than recorded the sensor's steps are simulated [s].
        lead_s: By how much the world adds to the actuator's delay [s].
    """
    start = max_delay_s / 4
    to_world = TrainableDist.create(start, 0.0, max_delay_s + lead_s, "zoh_mean", burst=BURST)
    world.connect(actuator, skip=True, delay_dist=to_world)
    sensor.connect(world, delay_dist=TrainableDist.create(start, 0.0, max_delay_s + ahead_s, "linear"))
    return {n.name: n for n in (sensor, actuator, world)}


def draw_values(
    key: jax.Array, values: Mapping[str, float], draws: Mapping[str, jax.Array], spread_s: float
) -> dict[str, Any]:
    """Draw the parameters of one episode.

    Args:
        key: JAX key.
        values: Parameters by name.
        draws: Dynamics that episodes take instead, ``(K,)`` each; one row is drawn for all of them.
        spread_s: Delays vary by this much either way [s].
    """
    row_key, *own = jax.random.split(key, 1 + len(values))
    keys = dict(zip(values, own, strict=True))
    count = min((len(d) for d in draws.values()), default=1)
    row = jax.random.randint(row_key, (), 0, count)
    drawn: dict[str, Any] = {}
    for name, value in values.items():
        if name.endswith("_delay"):
            shift = jax.random.uniform(keys[name], minval=-spread_s, maxval=spread_s)
            drawn[name] = jnp.maximum(value + shift, 0.0)
        else:
            drawn[name] = draws[name][row] if name in draws else value
    return drawn
