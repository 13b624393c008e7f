"""The table of a deployment's episodes: scores on the robot and of the same policy in simulation, lateness, pauses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, EpisodeRow, mean
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.installation import has_jax
from sim2real.later import jax
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, WORLD
from sim2real.robots.robot import Robot, as_columns, as_sent
from sim2real.robots.training import simulation_params, training_loop
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.types import PyTree

States = tuple[np.ndarray, dict[str, np.ndarray]]
"""Times ``(N,)`` [s], and columns: states ``(N,)``, and the commands, one a step."""
_MIN_SIMULATIONS, _MIN_PER_EPISODE = 32, 8
_LATENESS_PERIODS = 0.1
"""A step is late if it exceeds the longest of training by this share of the policy's period."""


def compare(
    robot: Robot,
    recordings: Sequence[Recording],
    bundle: Bundle,
    identification: Identification | None,
    duration_s: float,
) -> Deployment:
    """Return the table of a deployment's episodes: scores on the robot and in simulation, late steps and pauses.

    Scores compare states of one kind: true states if every recording has them, else states as the sensor measures
    them.

    Args:
        identification: Parameters of the simulations; None: none, except for a robot that is simulated in plain
            MuJoCo. The first simulation of each episode has the estimates, the others are draws from the posterior.
        duration_s: Length of a simulation [s].
    """
    use_truth = all(r.true_states() is not None for r in recordings)
    pairs = _simulated(robot, recordings, bundle, identification, duration_s, WORLD if use_truth else SENSOR)
    count, rows = len(recordings), []
    for i, recording in enumerate(recordings):
        real = _finite(robot.task.score(*_recorded(recording, robot, use_truth)))
        # Simulation e is of episode e % count.
        scores = [_finite(robot.task.score(t_s, states)) for (t_s, states), _ in pairs[i::count]]
        simulation = {name: mean([score.get(name) for score in scores]) for name in real} if scores else {}
        rows.append(EpisodeRow(real, simulation, late_shares(recording, bundle), paused_s(recording)))
    # The page shows the first simulation of each episode.
    columns = [{"t": t_s, **states} for _, (t_s, states) in pairs[:count]] or [{}] * count
    return Deployment(tuple(rows), simulated=tuple(columns), recordings=tuple(recordings))


def late_shares(recording: Recording, bundle: Bundle) -> dict[str, float]:
    """Return the share of each node's steps that take longer than the longest of training, by a tenth of a period."""
    shares, slack_s = {}, _LATENESS_PERIODS / bundle.contract.rate_hz
    for node, drawn_s in (bundle.episodes.drawn_s if bundle.episodes else {}).items():
        took_s = recording.timing.steps_s.get(node, np.empty(0))
        if drawn_s.size and took_s.size:
            shares[node] = float(np.mean(took_s > drawn_s.max() + slack_s))
    return shares


def paused_s(recording: Recording) -> float:
    """Return the time that the slowest node of an episode lost in steps of two periods or more [s]."""
    lost_s = [0.0]
    for steps in recording.episode.steps.values():
        # A step that is a little late is no pause: the node returns to its schedule.
        gaps_s = np.diff(steps.begun_s)
        if gaps_s.size:
            period_s = float(np.median(gaps_s))
            lost_s.append(float(np.sum(gaps_s[gaps_s >= 2.0 * period_s] - period_s)))
    return max(lost_s)


def _recorded(recording: Recording, robot: Robot, use_truth: bool) -> States:
    """Return the states of an episode on the robot: true states if they are used, else measured ones."""
    outputs, truth = recording.episode.outputs, recording.true_states() if use_truth else None
    sent = as_sent(robot, outputs[AGENT], outputs[ACTUATOR])
    if truth is not None:
        return truth[0], {**sent, **truth[1]}
    return recording.episode.steps[SENSOR].begun_s, {**sent, **as_columns(outputs[SENSOR])}


def _simulated(
    robot: Robot,
    recordings: Sequence[Recording],
    bundle: Bundle,
    identification: Identification | None,
    duration_s: float,
    node: str,
) -> list[tuple[States, States]]:
    """Return the simulations of a policy, in plain MuJoCo or in the compiled graph; see ``simulate``."""
    if not has_jax():
        return []
    from sim2real.robots.walking.twin import plain_episodes
    from sim2real.training.networks.policy import Policy

    values = None if identification is None else identification.values
    played = plain_episodes(robot, bundle.runner(), values, range(len(recordings)), duration_s)
    if played is not None or identification is None:
        return [(states, states) for states in played or []]
    policy, timing = Policy.from_weights(bundle.weights, bundle.spec), recordings[0].timing
    parameters = plausible_parameters(identification, len(recordings))
    rest = [_rest(robot, recording.episode) for recording in recordings]
    with progress(None, "simulate the same"):
        return patiently(lambda: simulate(robot, policy, parameters, timing, duration_s, rest, node))


def _rest(robot: Robot, episode: Episode) -> np.ndarray:
    """Return the first measured position of each channel ``(channels,)``."""
    fields = dict(named_leaves(episode.outputs[SENSOR]))
    return np.array([float(c.of(np.asarray(fields[c.position])).ravel()[0]) for c in robot.drive.channels])


def plausible_parameters(identification: Identification, episodes: int) -> list[dict[str, float]]:
    """Return the parameters of each simulation: the estimates for the first one of each episode, then posterior draws.

    The delays are the estimates in all simulations, because the graph is made for these.
    """
    from sim2real.training.environment.draws import draw_robots
    from sim2real.training.environment.variation import VariationConfig

    draws = draw_robots(identification.values, identification, VariationConfig(), 1.0, np.random.default_rng(0))
    names = [p.name for p in identification.parameters if p.kind == "dynamics" and p.name in draws]
    count = max(math.ceil(_MIN_SIMULATIONS / episodes), _MIN_PER_EPISODE) * episodes - episodes
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
) -> list[tuple[States, States]]:
    """Simulate the policy from where the robot rested; steps longer than a period of the policy are not drawn.

    After such a hiccup a node makes several steps at once, and the program would have to hold each of them.

    Args:
        parameters: Parameters of each simulation; simulation e is of episode ``e % len(rest)``.
        rest: The measured positions ``(channels,)`` at the start of each episode on the robot.
        scored_node: The node whose states are scored: the world, or the sensor.

    Returns:
        For each simulation the states of the scored node and those of the sensor; empty if the timing is too short to
        draw from.
    """
    from sim2real.graph.schedule import draw
    from sim2real.graph.windows import make_room
    from sim2real.robots.servo.world import ServoWorld
    from sim2real.runtime.compiled.graph import CompiledGraph

    # Draw the timelines from the robot's timing. An error must not lose the deployment.
    try:
        computation, hiccups = timing.computation(1.0 / robot.drive.rate_hz)
    except Sim2RealError as error:
        note(f"warning: nothing to compare with: {error.args[0]}")
        return []
    if hiccups:
        counts = ", ".join(f"{count} of {name}" for name, count in hiccups.items())
        note(f"the simulation omits steps that took longer than a period of the policy: {counts}")
    nodes, _ = training_loop(robot, parameters[0], {}, computation, True)
    if isinstance(world := nodes[WORLD], ServoWorld):
        world.solve_to_rest()
    count = len(parameters)
    timeline = draw(nodes, duration_s, count, 0)
    make_room(nodes, timeline)
    graph = CompiledGraph(nodes, AGENT, timeline)

    # Each simulation does the trial of its episode, from where the robot rested: friction holds it beside the task's
    # start, and a swing-up from there may go to the other side.
    episodes = [(e % len(rest), rest[e % len(rest)]) for e in range(count)]
    trials = [simulation_params(robot, v, policy, *e) for v, e in zip(parameters, episodes, strict=True)]
    params = jax.tree_util.tree_map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trials)
    recorded = tuple({scored_node, SENSOR, AGENT, ACTUATOR})

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
        columns = {**as_sent(robot, sent(AGENT, e), sent(ACTUATOR, e)), **as_columns(sent(node, e))}
        # The message of a tick of the world is the state at its end.
        own, rate = steps(node, e), graph.nodes[node].rate
        t_s = (own + 1) / rate if node == WORLD else vertices[node].start[e][own] / TICKS_PER_S
        return t_s, {**columns, "t_command": command_s}

    return [(states(e, scored_node), states(e, SENSOR)) for e in range(count)]


def _finite(score: Mapping[str, float]) -> dict[str, float | None]:
    """Return None for a score that does not exist, such as the time to a goal that was not reached."""
    return {name: value if math.isfinite(value) else None for name, value in score.items()}
