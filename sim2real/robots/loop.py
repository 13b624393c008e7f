"""The control loop of sensor, agent, actuator and world: connections, delays, identification, training."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import BaseNode, Scheduling
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.later import jax, jnp
from sim2real.robots.messages import EpisodeStart
from sim2real.training.environment.tasks import Rewards, TrainingTask
from sim2real.types import Array, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.robots.robot import Robot

SENSOR, AGENT, ACTUATOR, WORLD = "sensor", "agent", "actuator", "world"
"""Names of the nodes: what measures, what decides (the policy makes its steps), what sends commands to the motors, and
the robot with its surroundings in simulation."""
ROLES = {"sensor": SENSOR, "supervisor": AGENT, "actuator": ACTUATOR, "world": WORLD}
"""Role -> node, as the metadata of a log has it."""
BURST = 3
"""Extra messages in the world's window of commands. After a hiccup, the actuator makes its missed steps one right after
the other, so that commands come faster than its rate for a moment."""
DELAYS = ("sensor_delay", "actuator_delay")
"""Names of the two delays: from the world to the sensor, and from the actuator to the world."""
Draw = Callable[["jax.Array"], dict[str, PyTree]]
"""Draws dynamics and delays of an episode: key -> values by name."""
EMPTY: Mapping[str, np.ndarray] = MappingProxyType({})
"""No samples."""


@pytree.dataclass
class DelayParams(Base):
    """Parameters of a simulated sensor or actuator.

    Attributes:
        delay: Delay of its connection with the world [s]; None: as the connection was made.
        noise: Factor on deviation and bias of a sensor's noise; None: 1.
    """

    delay: Scalar | None = None
    noise: Scalar | None = None


def delay_of(node: str, input_name: str, graph_state: GraphState | None) -> dict[str, PyTree]:
    """Return the result of ``init_delays``: the delay in a node's ``DelayParams``, if it has one.

    Args:
        input_name: The input that it belongs to.
        graph_state: The graph's state, with the parameters; None: no delay.

    Returns:
        Input name -> delay [s], or empty.
    """
    delay = getattr((graph_state or GraphState()).params.get(node), "delay", None)
    return {} if delay is None else {input_name: delay}


def delay_parameters(max_delay_s: float) -> list[Parameter]:
    """Return the delays as parameters: from the world to the sensor, and from the actuator to the world.

    A log determines their sum alone: with one longer and the other shorter by as much, and a world that is as much
    earlier, every message stays the same. So the first is a constant, and the second, up to twice ``max_delay_s``, is
    identified: it is the sum.

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
    spread_s: float,
    lead_s: float = 0.0,
    draws: Mapping[str, np.ndarray] = EMPTY,
) -> dict[str, tuple[float, float, float]]:
    """Return the bounds of the trainable delays for training.

    Args:
        values: Both delays by name [s].
        tick_s: The world's period [s], over which the sensor interpolates.
        spread_s: Largest deviation of an episode's delay from its value [s].
        lead_s: Time that the world adds to the actuator's delay [s]; see ``ServoWorld.init_delays``.
        draws: Samples that episodes use in place of the values, each of shape ``(K,)`` [s].

    Returns:
        Name -> (value, min, max) [s].
    """
    bounds = {}
    for name, lead in zip(DELAYS, (0.0, lead_s), strict=True):
        delays = np.append(draws.get(name, []), values[name])
        low, high = float(delays.min()) - tick_s - spread_s, float(delays.max()) + spread_s
        bounds[name] = (values[name] + lead, max(0.0, low), high + lead)
    return bounds


def split_delay(values: Mapping[str, float], tick_s: float, spread_s: float) -> dict[str, float]:
    """Return parameters with part of the actuator's delay moved to the sensor, as far as a simulated loop needs it.

    The simulated sensor interpolates between ticks of the world, so its delay must be at least one tick: the next tick
    is not simulated yet. Only the sum of both delays affects a policy's observations of its commands.

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
    """Return samples of parameters with the sensor's delay as ``split_delay`` has it, as far as the sum of both allows.

    The variation of the sum is then in the actuator's delay: only the sum affects a policy.

    Args:
        values: Parameters by name, with both delays [s] or neither; a delay that is not drawn is as here.
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

    Agent and actuator have blocking inputs and ``Scheduling.PHASE``: after a hiccup they make the steps that they
    missed one right after the other and return to their grid. With ``FREQUENCY``, a single step of 100 ms would delay
    their schedules for good, and all later actions would use data that are 80 ms old while newer messages wait. The
    sensor has no blocking input and keeps ``FREQUENCY``, so its samples are never old nor closer together than its
    period. Without overruns the two options are the same.

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
    # skip=True: the delay must not shift the sensor's phase, as a real sensor does not wait for the world either.
    sensor.connect(world, skip=True, delay_dist=from_world)
    return {**nodes, world.name: world}


def recorded_loop(
    sensor: BaseNode, actuator: BaseNode, world: BaseNode, max_delay_s: float, ahead_s: float, lead_s: float = 0.0
) -> dict[str, BaseNode]:
    """Connect the nodes that identification simulates: recorded commands drive the world, the sensor measures it.

    Args:
        max_delay_s: Upper bound of the sensor's delay, and half of that of the actuator's [s].
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


def draw_values(key: jax.Array, values: Mapping[str, float], draws: Mapping[str, jax.Array]) -> dict[str, PyTree]:
    """Draw the parameters of one episode.

    Args:
        draws: Samples of some parameters, each of shape ``(K,)``; one of the K joint samples is drawn in place of the
            values.

    Returns:
        Parameters by name.
    """
    count = min((len(d) for d in draws.values()), default=1)
    row = jax.random.randint(key, (), 0, count)
    return {name: draws[name][row] if name in draws else value for name, value in values.items()}


class IdentifiableLoop:
    """Simulates the sensor's measurements from recorded commands; an ``identification.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of each of the two delays [s].
    """

    sensor = SENSOR

    def __init__(self, robot: Robot, max_delay_s: float) -> None:
        self._robot = robot
        self.parameters = ParameterTable([*robot.model.dynamics(), *delay_parameters(max_delay_s)])
        self.ahead_s, self.channels = robot.model.tick_s, robot.sensor.channels
        message = robot.sim_actuator().init_output()
        fields = pytree.structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, PyTree] = {ACTUATOR: fields}
        self._aim = np.zeros_like(robot.task.at_rest(0).aim)

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.model.make_world(resumed=True)
        sensor = robot.sim_sensor(world)
        return recorded_loop(sensor, robot.sim_actuator(), world, max_delay_s, self.ahead_s, robot.model.lead_s)

    def reached(self, recordings: Sequence[Episode]) -> Mapping[str, float]:
        """Return an empty dict: there are no limits among the optional terms."""
        return {}

    def params(self, values: Mapping[str, Scalar], start: Array) -> dict[str, PyTree]:
        """Return the nodes' parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        position, velocity = jnp.split(jnp.asarray(start), 2, axis=-1)
        params = self._robot.node_parameters(values, EpisodeStart(position, velocity, self._aim))
        del params[AGENT]
        return {**params, SENSOR: DelayParams(values[DELAYS[0]] + self.ahead_s)}


class LoopTask(TrainingTask):
    """The training task of a robot in a loop.

    Args:
        draws: Samples of some parameters, each of shape ``(K,)``; one of the K joint samples is drawn for each episode
            in place of the values.

    Attributes:
        start: Largest change of a joint's position [rad] and of its velocity [rad/s] at the start of an episode.
    """

    supervisor = AGENT
    has_curriculum = True

    def __init__(self, robot: Robot, agent: Any, values: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> None:
        self.robot, self.agent = robot, agent
        self.values: dict[str, PyTree] = dict(values)
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.observation_size = robot.agent.observation_size
        self.start = (0.0, 0.0)
        self.action_low, self.action_high = np.array([(t.low, t.high) for t in robot.agent.action], np.float32).T

    @property
    def data(self) -> PyTree:
        """The values and samples of the parameters; see ``HoldsData``."""
        return {n: jnp.asarray(v, jnp.float32) for n, v in self.values.items()}, self.draws

    def with_data(self, data: PyTree) -> LoopTask:
        """Return a copy with other values and samples, which may be traced."""
        task = copy.copy(self)
        task.values, task.draws = data
        return task

    def params(self, key: jax.Array, width: jax.Array | None = None) -> dict[str, PyTree]:
        draw, task = partial(self._draw, width=width), self.robot.task
        # Draw values and start; then move the start, and scale the noise.
        if any(self.start):
            key, key_start = jax.random.split(key)
            values, start = task.random(key, draw)
            start = task.moved(start, *self.offsets(key_start, width))
        else:
            values, start = task.random(key, draw)
        if width is None:
            return self.robot.node_parameters(values, start)
        params = self.robot.node_parameters(values, task.narrowed(start, width))
        return {**params, SENSOR: params[SENSOR].replace(noise=width)}

    def offsets(self, key: jax.Array, width: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Draw the offsets of an episode's start: positions [rad] and velocities [rad/s], ``(joints,)`` each.

        Args:
            width: Share of the differences; None: all of them.
        """
        share = 1.0 if width is None else width
        drawn = share * jax.random.uniform(key, (2, len(self.robot.sensor.channels)), minval=-1.0, maxval=1.0)
        return self.start[0] * drawn[0], self.start[1] * drawn[1]

    def observe(self, step_state: StepState) -> jax.Array:
        return self.agent.observe(step_state)

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, PyTree]:
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        return self.robot.task.reward(self.robot.task.judged(graph_state), action)

    def success(self, graph_state: GraphState) -> jax.Array:
        return self.robot.task.success(self.robot.task.judged(graph_state))

    def terminated(self, graph_state: GraphState) -> jax.Array:
        return self.robot.task.terminated(self.robot.task.judged(graph_state))

    def privileged(self, graph_state: GraphState) -> jax.Array:
        state = self.robot.model.true_state(graph_state.state[WORLD])
        numbers = [x for x in map(jnp.asarray, jax.tree.leaves((state, graph_state.params)))]
        numbers = [x for x in numbers if jnp.issubdtype(x.dtype, jnp.inexact)]
        return jnp.concatenate([x.astype(jnp.float32).ravel() for x in numbers])

    def _draw(self, key: jax.Array, width: jax.Array | None) -> dict[str, PyTree]:
        drawn = draw_values(key, self.values, self.draws)
        if width is None:
            return drawn
        return {n: value + width * (drawn[n] - value) if n in self.draws else value for n, value in self.values.items()}
