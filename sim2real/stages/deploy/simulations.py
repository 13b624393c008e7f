"""Simulations of a deployed policy, on timelines like those of the robot."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import make_room
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, WORLD
from sim2real.robots.robot import Robot, as_columns, as_sent
from sim2real.robots.servo.world import ServoWorld
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.terminal.console import note
from sim2real.training.environment.draws import draw_robots
from sim2real.training.environment.variation import VariationConfig
from sim2real.types import PyTree

_MIN_SIMULATIONS, _MIN_PER_EPISODE = 32, 8
States = tuple[np.ndarray, dict[str, np.ndarray]]
"""Times ``(N,)`` [s], and columns: states ``(N,)``, and the commands, one a step."""


def plausible_parameters(identification: Identification, episodes: int) -> list[dict[str, float]]:
    """Return the parameters of each simulation: the estimates for the first one of each episode, then posterior draws.

    The delays are the estimates in all simulations, because the graph is made for these.
    """
    draws = draw_robots(identification.values, identification, VariationConfig(), 1.0, np.random.default_rng(0))
    names = [p.name for p in identification.parameters if p.kind == "dynamics" and p.name in draws]
    count = max(_MIN_SIMULATIONS, _MIN_PER_EPISODE * episodes) - episodes
    estimates = dict(identification.values)
    return [estimates] * episodes + [estimates | {n: float(draws[n][i]) for n in names} for i in range(count)]


def simulate(
    robot: Robot,
    policy: Any,
    parameters: Sequence[Mapping[str, float]],
    timing: Timing,
    duration_s: float,
    rest: Sequence[np.ndarray],
    scored_node: str,
) -> tuple[list[tuple[States, States]] | None, Timeline | None]:
    """Simulate the policy from where the robot rested; steps longer than a period of the policy are not drawn.

    After such a hiccup a node makes several steps at once, and the program would have to hold each of them. The ages
    in the gap report show the hiccups on the robot.

    Args:
        parameters: Parameters of each simulation; simulation e is of episode ``e % len(rest)``.
        rest: The measured positions ``(channels,)`` at the start of each episode on the robot.
        scored_node: The node whose states are scored: the world, or the sensor.

    Returns:
        For each simulation the states of the scored node and those of the sensor, and the timelines; None and None if
        the timing is too short to draw from.
    """
    # Draw the timelines from the robot's timing. An error must not lose the deployment.
    try:
        computation, hiccups = timing.computation(1.0 / robot.rate_hz)
    except Sim2RealError as error:
        note(f"warning: nothing to compare with: {error.args[0]}")
        return None, None
    if hiccups:
        counts = ", ".join(f"{count} of {name}" for name, count in hiccups.items())
        note(f"the simulation omits steps that took longer than a period of the policy: {counts}")
    nodes, _ = robot.training(parameters[0], {}, computation, True)
    if isinstance(world := nodes[WORLD], ServoWorld):
        world.solve_to_rest()
    count = len(parameters)
    timeline = draw(nodes, duration_s, count, 0)
    make_room(nodes, timeline)
    graph = CompiledGraph(nodes, AGENT, timeline)

    # Each simulation does the trial of its episode, from where the robot rested: friction holds it beside the task's
    # start, and a swing-up from there may go to the other side.
    episodes = [(e % len(rest), rest[e % len(rest)]) for e in range(count)]
    trials = [robot.simulation_params(v, policy, *e) for v, e in zip(parameters, episodes, strict=True)]
    params = jax.tree_util.tree_map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trials)
    recorded = tuple({scored_node, SENSOR, AGENT, ACTUATOR})

    def rollout(eps: jax.Array, params: PyTree) -> PyTree:
        return graph.rollout(graph.init(jax.random.key(0), params, eps=eps), record=recorded)[1]

    records = jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(rollout))(np.arange(count), params))
    return [
        (_states(graph, records, robot, e, scored_node), _states(graph, records, robot, e, SENSOR))
        for e in range(count)
    ], timeline


def _states(graph: CompiledGraph, records: Mapping[str, Any], robot: Robot, e: int, node: str) -> States:
    """Return times [s] and columns of simulation ``e``, with the states that a node sends."""

    def steps(name: str) -> np.ndarray:
        return records[name].seq[e][records[name].seq[e] >= 0]

    def sent(name: str) -> dict[str, np.ndarray]:
        ran = records[name].seq[e] >= 0
        return {n: np.asarray(leaf)[e][ran] for n, leaf in named_leaves(records[name].output).items()}

    actuator, vertices = ACTUATOR, graph.timeline.vertices
    command_s = vertices[actuator].end[e][steps(actuator)] / TICKS_PER_S
    columns = {**as_sent(robot, sent(AGENT), sent(actuator)), **as_columns(sent(node))}
    if node == WORLD:
        # The message of a tick is the state at its end.
        t_s = (steps(node) + 1) / graph.nodes[node].rate
    else:
        t_s = vertices[node].start[e][steps(node)] / TICKS_PER_S
    return t_s, {**columns, "t_command": command_s}
