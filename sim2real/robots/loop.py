"""The control loop of sensor, agent, actuator and world: its names, its connections and its delays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, Scheduling
from sim2real.identification.parameters import Parameter
from sim2real.types import PyTree

if TYPE_CHECKING:
    import jax

SENSOR, AGENT, ACTUATOR, WORLD = "sensor", "agent", "actuator", "world"
"""Names of the nodes: the sensor, the policy, the node that sends commands to the motors, and the simulated robot."""
ROLES = {"sensor": SENSOR, "supervisor": AGENT, "actuator": ACTUATOR, "world": WORLD}
"""Role -> node, as in the metadata of a log."""
BURST = 3
"""Extra messages in the world's window of commands: after a hiccup, the actuator makes up for missed steps, so that
commands come faster than its rate for a moment.
"""
DELAYS = ("sensor_delay", "actuator_delay")
"""Names of the two delays: from the world to the sensor, and from the actuator to the world."""
Draw = Callable[["jax.Array"], dict[str, PyTree]]
"""Draws the parameters of an episode: key -> values by name."""
DELAY_SPREAD_S = 0.002
"""Largest deviation, up or down, of an episode's delay from the nominal one [s]."""
EMPTY: Mapping[str, np.ndarray] = MappingProxyType({})
"""No samples of parameters."""


def delay_parameters(max_delay_s: float) -> list[Parameter]:
    """Return the delays as parameters: from the world to the sensor, and from the actuator to the world.

    A log determines only their sum: if one is longer, the other shorter, and the world earlier by the same time, every
    message stays the same. So the first is fixed, and the second, up to twice ``max_delay_s``, is identified as the
    sum.

    Args:
        max_delay_s: Upper bound of the sensor's delay [s].
    """
    delay = Parameter("", "s", 0.0, 0.0, max_delay_s, "linear", "delay")
    about = "from motion to measurement's time stamp", "from command's departure to the motor"
    return [
        replace(delay, name=DELAYS[0], about=about[0], leaf=f"{SENSOR}.delay", side="measurement", free=False),
        replace(delay, name=DELAYS[1], about=about[1], leaf=f"{ACTUATOR}.delay", side="command", high=2 * max_delay_s),
    ]


def delay_bounds(
    values: Mapping[str, float],
    tick_s: float,
    spread_s: float = DELAY_SPREAD_S,
    lead_s: float = 0.0,
    draws: Mapping[str, np.ndarray] = EMPTY,
) -> dict[str, tuple[float, float, float]]:
    """Return the bounds of the trainable delays for training.

    Args:
        values: Both delays by name [s].
        tick_s: The world's period [s], over which the sensor interpolates.
        spread_s: Largest deviation of an episode's delay from its value [s].
        lead_s: Time that the world adds to the actuator's delay [s]; see ``ServoWorld.init_delays``.
        draws: Samples that episodes use instead of the values, each of shape ``(K,)`` [s].

    Returns:
        Name -> (value, min, max) [s].
    """
    bounds = {}
    for name, lead in zip(DELAYS, (0.0, lead_s), strict=True):
        delays = np.append(draws.get(name, []), values[name])
        low, high = float(delays.min()) - tick_s - spread_s, float(delays.max()) + spread_s
        bounds[name] = (values[name] + lead, max(0.0, low), high + lead)
    return bounds


def split_delay(values: Mapping[str, float], tick_s: float, spread_s: float = DELAY_SPREAD_S) -> dict[str, float]:
    """Return parameters with part of the actuator's delay moved to the sensor, as a simulated loop needs.

    The simulated sensor interpolates between ticks of the world, so its delay must be at least one tick: the next tick
    is not simulated yet. A policy notices only the sum of both delays.

    Args:
        values: Parameters by name, with both delays [s] or neither.
        tick_s: The world's period [s].
        spread_s: Largest deviation of an episode's delay from its value [s].
    """
    if not set(DELAYS) <= set(values):
        return dict(values)
    total = values[DELAYS[0]] + values[DELAYS[1]]
    sensor = min(max(values[DELAYS[0]], tick_s + spread_s), total)
    return {**values, DELAYS[0]: sensor, DELAYS[1]: total - sensor}


def split_drawn_delay(
    values: Mapping[str, float], draws: Mapping[str, np.ndarray], tick_s: float, spread_s: float
) -> dict[str, np.ndarray]:
    """Return samples of parameters with the sensor's delay of ``split_delay``, or the whole sum if that is shorter.

    The rest of the sum, and so its variation, is the actuator's delay.

    Args:
        values: Parameters by name, with both delays [s] or neither; used for a delay without samples.
        draws: Samples of some parameters, each of shape ``(K,)``, delays in [s].
        tick_s: The world's period [s].
        spread_s: Largest deviation of an episode's delay from its value [s].
    """
    if not (set(DELAYS) & set(draws) and set(DELAYS) <= set(values)):
        return dict(draws)
    total = np.asarray(sum(draws.get(name, values[name]) for name in DELAYS))
    sensor = np.minimum(split_delay(values, tick_s, spread_s)[DELAYS[0]], total)
    return {**draws, DELAYS[0]: sensor, DELAYS[1]: total - sensor}


def control_nodes(sensor: BaseNode, agent: BaseNode, actuator: BaseNode) -> dict[str, BaseNode]:
    """Connect sensor, agent and actuator, on hardware as in simulation.

    Agent and actuator have blocking inputs and ``Scheduling.PHASE``: after a hiccup they make the missed steps without
    pauses and return to their grid. With ``FREQUENCY``, a single step of 100 ms would delay their schedules for good,
    and all later actions would use data that are 80 ms old while newer messages wait. The sensor has no blocking input
    and keeps ``FREQUENCY``, so its samples are never old nor closer together than its period.

    Returns:
        The three nodes by name.
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
    """Connect the whole loop in simulation, for training and for comparison with hardware.

    Args:
        delays: Result of ``delay_bounds``; None: no delays.

    Returns:
        The four nodes by name.
    """
    nodes = control_nodes(sensor, agent, actuator)
    to_world = TrainableDist.create(*delays[DELAYS[1]], "zoh_mean", BURST) if delays else None
    from_world = TrainableDist.create(*delays[DELAYS[0]], "linear") if delays else None
    world.connect(actuator, skip=True, delay_dist=to_world)
    # skip=True, so that the delay does not shift the sensor's phase: a real sensor does not wait for the world, either.
    sensor.connect(world, skip=True, delay_dist=from_world)
    return {**nodes, world.name: world}


def recorded_loop(
    sensor: BaseNode, actuator: BaseNode, world: BaseNode, max_delay_s: float, ahead_s: float, lead_s: float = 0.0
) -> dict[str, BaseNode]:
    """Connect the nodes that identification simulates: recorded commands drive the world, the sensor measures it.

    Args:
        max_delay_s: Upper bound of the sensor's delay [s]; the actuator's is twice as large.
        ahead_s: How much later than recorded the sensor's steps are simulated [s].
        lead_s: Time that the world adds to the actuator's delay [s].

    Returns:
        The three nodes by name.
    """
    start = max_delay_s / 4
    to_world = TrainableDist.create(start, 0.0, 2 * max_delay_s + lead_s, "zoh_mean", burst=BURST)
    world.connect(actuator, skip=True, delay_dist=to_world)
    sensor.connect(world, delay_dist=TrainableDist.create(start, 0.0, max_delay_s + ahead_s, "linear"))
    return {n.name: n for n in (sensor, actuator, world)}
