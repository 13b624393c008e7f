"""A robot's loop in simulation: model to identify, graph and task of a training, and an episode from rest."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Unpack

import numpy as np

from sim2real import pytree
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import named_leaves
from sim2real.graph.node import TICKS_PER_S, BaseNode, NodeOptions
from sim2real.identification.parameters import ParameterTable
from sim2real.later import jax, jnp
from sim2real.policy.contract import observation_size
from sim2real.robots.agent import AgentParams, PolicyAgent
from sim2real.robots.loop import (
    ACTUATOR,
    AGENT,
    DELAY_SPREAD_S,
    DELAYS,
    SENSOR,
    WORLD,
    delay_bounds,
    delay_parameters,
    recorded_loop,
    simulated_loop,
    split_delay,
    split_drawn_delay,
)
from sim2real.robots.messages import EpisodeStart, States, Trials, as_columns, as_sent
from sim2real.robots.nodes import SimActuator, SimSensor
from sim2real.training.environment.tasks import Rewards, TrainingTask
from sim2real.types import Array, PyTree, Scalar
from sim2real.worlds.recorded import DelayParams

if TYPE_CHECKING:
    from sim2real.robots.robot import Robot


# -- the parts of the graph


def node_parameters(
    robot: Robot, values: Mapping[str, Scalar], start: EpisodeStart, policy: PyTree = None
) -> dict[str, PyTree]:
    """Return the parameters of all nodes in simulation, from values by name and a start."""
    return {
        WORLD: robot.model.params(values, start),
        SENSOR: DelayParams(delay=values.get(DELAYS[0])),
        ACTUATOR: DelayParams(delay=values.get(DELAYS[1])),
        AGENT: AgentParams.of(start, policy),
    }


def _sim_actuator(robot: Robot, **options: Unpack[NodeOptions]) -> SimActuator:
    drive = robot.drive
    return SimActuator(ACTUATOR, drive.rate_hz, len(robot.task.action), drive.message, **options)


def _lead_s(world: BaseNode) -> float:
    """Return the time that a world adds to the actuator's delay [s]; see ``ServoWorld``."""
    return getattr(world, "lead_s", 0.0)


# -- training, and a simulated episode for comparison with the robot


def training_loop(
    robot: Robot,
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    computation: Mapping[str, DelayDistribution],
    delays: bool,
    spread_s: float = DELAY_SPREAD_S,
) -> tuple[dict[str, BaseNode], LoopTask]:
    """Return the graph of a robot in simulation, and the training task.

    Args:
        draws: Samples of some parameters, each of shape ``(K,)``; an episode uses one of the K joint samples in place
            of the values.
        computation: Node -> distribution of its computation delay.
        delays: Whether the connections have delays.
        spread_s: Largest deviation of an episode's delay from its value [s]; windows have room for it.
    """
    robot = copy.copy(robot)
    robot.model = robot.model.for_training(values, draws)
    drive, tick_s, world = robot.drive, robot.model.tick_s, robot.model.make_world()
    # Split the delay between sensor and actuator as a simulated loop needs, and make room for all samples.
    draws = split_drawn_delay(values, draws, tick_s, spread_s)
    values = split_delay(values, tick_s, spread_s)
    bounds = delay_bounds(values, tick_s, spread_s, _lead_s(world), draws) if delays else None
    on_sensor, on_agent, on_actuator = (
        {"delay": delay_s if delays else 0.0, "delay_dist": computation.get(name)}
        for name, delay_s in zip((SENSOR, AGENT, ACTUATOR), drive.expected_delay_s, strict=True)
    )
    agent = robot.task.make_agent(drive.rate_hz, **on_agent)
    sensor = SimSensor(SENSOR, drive.rate_hz, world, **on_sensor)
    sensor.noise = robot.drive.noise
    nodes = simulated_loop(sensor, agent, _sim_actuator(robot, **on_actuator), world, bounds)
    return nodes, LoopTask(robot, agent, world, values, draws)


def simulation_params(
    robot: Robot, values: Mapping[str, float], policy: PyTree, trial: int = 0, measured: np.ndarray | None = None
) -> dict[str, PyTree]:
    """Return the nodes' parameters for an episode in simulation that starts at rest.

    Args:
        measured: Positions ``(channels,)`` where the robot rested; friction may hold it off the task's position at
            rest.
    """
    values, start = split_delay(values, robot.model.tick_s), robot.task.at_rest(trial)
    if measured is not None:
        offset = measured - np.asarray(start.position)
        angles = [robot.drive.units.get(channel.position) == "rad" for channel in robot.drive.channels]
        # Remove whole turns of a hinge without range.
        offset -= np.where(angles, 2 * np.pi * np.round(offset / (2 * np.pi)), 0.0)
        # Do not call `moved`, which keeps starts within the bounds of goals: a robot may rest beyond them, on a stop.
        start = start.replace(position=start.position + offset)
    return node_parameters(robot, values, start, policy)


def simulate(robot: Robot, policy: PyTree, trials: Trials) -> list[tuple[States, States]]:
    """Return simulations of a policy in one compiled graph; see ``Robot.simulated``."""
    from sim2real.graph.schedule import draw
    from sim2real.graph.windows import make_room
    from sim2real.runtime.compiled.graph import CompiledGraph

    # Draw the timelines.
    parameters, computation, rest, duration_s, node, _ = trials
    nodes, _ = training_loop(robot, parameters[0], {}, computation, True)
    if (solve_to_rest := getattr(nodes[WORLD], "solve_to_rest", None)) is not None:
        solve_to_rest()
    count = len(parameters)
    timeline = draw(nodes, duration_s, count, 0)
    make_room(nodes, timeline)
    graph = CompiledGraph(nodes, AGENT, timeline)

    # Each simulation does the trial of its episode, from where the robot rested: friction holds it beside the task's
    # start, and a swing-up from there may go to the other side.
    episodes = [(e % len(rest), rest[e % len(rest)]) for e in range(count)]
    each = [simulation_params(robot, v, policy, *e) for v, e in zip(parameters, episodes, strict=True)]
    params = jax.tree_util.tree_map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *each)
    recorded = tuple({node, SENSOR, AGENT, ACTUATOR})

    def rollout(eps: jax.Array, params: PyTree) -> PyTree:
        return graph.rollout(graph.init(jax.random.key(0), params, eps=eps), record=recorded)[1]

    records = jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(rollout))(np.arange(count), params))

    # Read the states that a node sends, and the commands.
    def steps(name: str, e: int) -> np.ndarray:
        return records[name].seq[e][records[name].seq[e] >= 0]

    def sent(name: str, e: int) -> dict[str, np.ndarray]:
        ran = records[name].seq[e] >= 0
        return {n: np.asarray(leaf)[e][ran] for n, leaf in named_leaves(records[name].output).items()}

    def states(e: int, node: str) -> States:
        vertices = timeline.vertices
        command_s = vertices[ACTUATOR].end[e][steps(ACTUATOR, e)] / TICKS_PER_S
        columns = {**as_sent(robot.drive.command, sent(AGENT, e), sent(ACTUATOR, e)), **as_columns(sent(node, e))}
        # The message of a tick of the world is the state at its end.
        own, rate = steps(node, e), graph.nodes[node].rate
        t_s = (own + 1) / rate if node == WORLD else vertices[node].start[e][own] / TICKS_PER_S
        return t_s, {**columns, "t_command": command_s}

    return [(states(e, node), states(e, SENSOR)) for e in range(count)]


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

    def __init__(
        self,
        robot: Robot,
        agent: PolicyAgent,
        world: BaseNode,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
    ) -> None:
        self.robot, self.agent = robot, agent
        self._true_state = getattr(world, "true_state", lambda state: state)
        self.values: dict[str, PyTree] = dict(values)
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.observation_size = observation_size(robot.task.observation)
        self.start = (0.0, 0.0)
        self.action_low, self.action_high = np.array([(t.low, t.high) for t in robot.task.action], np.float32).T

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
        draw, task, offsets = partial(self._draw, width=width), self.robot.task, None
        # Draw values and start; then move the start, and scale difficulty and noise.
        if any(self.start):
            key, key_start = jax.random.split(key)
            offsets = self.offsets(key_start, width)
        values, start = task.random(key, draw)
        if offsets is not None or width is not None:
            still = jnp.zeros(len(self.robot.drive.channels))
            start = task.moved(start, *(offsets or (still, still)), 1.0 if width is None else width)
        params = node_parameters(self.robot, values, start)
        return params if width is None else {**params, SENSOR: params[SENSOR].replace(noise=width)}

    def offsets(self, key: jax.Array, width: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Draw the offsets of an episode's start: positions [rad] and velocities [rad/s], ``(joints,)`` each.

        Args:
            width: Share of the differences; None: all of them.
        """
        share = 1.0 if width is None else width
        drawn = share * jax.random.uniform(key, (2, len(self.robot.drive.channels)), minval=-1.0, maxval=1.0)
        return self.start[0] * drawn[0], self.start[1] * drawn[1]

    def observe(self, step_state: StepState) -> jax.Array:
        return jnp.asarray(self.agent.observe(step_state))

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, PyTree]:
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        return self.robot.task.judge(graph_state, action).reward

    def success(self, graph_state: GraphState) -> jax.Array:
        return self.robot.task.judge(graph_state, jnp.zeros(len(self.action_low))).success

    def terminated(self, graph_state: GraphState) -> jax.Array:
        return jnp.asarray(self.robot.task.judge(graph_state, jnp.zeros(len(self.action_low))).ended)

    def privileged(self, graph_state: GraphState) -> jax.Array:
        state = self._true_state(graph_state.state[WORLD])
        numbers = [x for x in map(jnp.asarray, jax.tree.leaves((state, graph_state.params)))]
        numbers = [x for x in numbers if jnp.issubdtype(x.dtype, jnp.inexact)]
        return jnp.concatenate([x.astype(jnp.float32).ravel() for x in numbers])

    def _draw(self, key: jax.Array, width: jax.Array | None) -> dict[str, PyTree]:
        drawn = draw_values(key, self.values, self.draws)
        if width is None:
            return drawn
        return {n: value + width * (drawn[n] - value) if n in self.draws else value for n, value in self.values.items()}


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


# -- identification


class IdentifiableLoop:
    """Simulates the sensor's measurements from recorded commands; an ``identification.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of each of the two delays [s].
    """

    sensor = SENSOR

    def __init__(self, robot: Robot, max_delay_s: float) -> None:
        self._robot = robot
        self.parameters = ParameterTable([*robot.model.dynamics(), *delay_parameters(max_delay_s)])
        self.ahead_s, self.channels = robot.model.tick_s, robot.drive.channels
        message = _sim_actuator(robot).init_output()
        fields = pytree.structure(message).unflatten(list(named_leaves(message)))
        self.given: Mapping[str, PyTree] = {ACTUATOR: fields}
        self._aim = np.zeros_like(robot.task.at_rest(0).aim)

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        robot, world = self._robot, self._robot.model.make_world(resumed=True)
        sensor = SimSensor(SENSOR, robot.drive.rate_hz, world)
        return recorded_loop(sensor, _sim_actuator(robot), world, max_delay_s, self.ahead_s, _lead_s(world))

    def params(self, values: Mapping[str, Scalar], start: Array) -> dict[str, PyTree]:
        """Return the nodes' parameters.

        Args:
            start: Shape ``(2 * channels,)``: initial positions, then velocities.
        """
        position, velocity = jnp.split(jnp.asarray(start), 2, axis=-1)
        params = node_parameters(self._robot, values, EpisodeStart(position, velocity, self._aim))
        del params[AGENT]
        return {**params, SENSOR: DelayParams(values[DELAYS[0]] + self.ahead_s)}
