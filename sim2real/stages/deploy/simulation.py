"""The policy of a deployment in simulation: the states of both, their scores, and the gap between them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, Gap, Scores
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import newest_message
from sim2real.installation import has_jax
from sim2real.later import jax
from sim2real.log.session import input_ages
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, WORLD
from sim2real.robots.robot import Robot, as_columns, as_sent
from sim2real.robots.training import simulation_params, training_loop
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.types import PyTree

States = tuple[np.ndarray, dict[str, np.ndarray]]
"""Times ``(N,)`` [s], and columns: states ``(N,)``, and the commands, one a step."""
_MIN_SIMULATIONS, _MIN_PER_EPISODE = 32, 8


def compare(
    robot: Robot,
    recordings: Sequence[Recording],
    bundle: Bundle,
    identification: Identification | None,
    duration_s: float,
) -> Deployment:
    """Return the scores of a deployment beside those of simulations of the same policy.

    Scores compare states of one kind: true states if every recording has them, else states as the sensor measures
    them.

    Args:
        identification: Parameters of the simulations; None: none, except for a robot that is simulated in plain
            MuJoCo. The first simulation of each episode has the estimates, the others are draws from the posterior.
        duration_s: Length of a simulation [s].
    """
    use_truth = all(r.true_states() is not None for r in recordings)
    real = [_recorded(recording, robot, use_truth) for recording in recordings]
    node = WORLD if use_truth else SENSOR
    pairs, timeline = _simulated(robot, recordings, bundle, identification, duration_s, node)

    # Compare scores and ages. The page shows the first simulation of each episode.
    on_robot = [_finite(robot.task.score(t, s)) for t, s in real]
    in_simulation = [_finite(robot.task.score(t, s)) for (t, s), _ in pairs]
    gap = [
        _gap(quantity, *(_mean([each[quantity] for each in scores]) for scores in (on_robot, in_simulation)))
        for quantity in on_robot[0]
    ]
    beside = [*in_simulation[: len(real)], *[None] * (len(real) - len(in_simulation))]
    scores = tuple(Scores(r, s) for r, s in zip(on_robot, beside, strict=True))
    columns: list[dict[str, np.ndarray]] = [{"t": t, **states} for _, (t, states) in pairs[: len(real)]]
    columns += [{}] * (len(real) - len(columns))
    gap += age_rows([r.episode for r in recordings], timeline)
    return Deployment(scores, tuple(gap), dict(robot.units), tuple(columns), tuple(recordings))


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
) -> tuple[list[tuple[States, States]], Timeline | None]:
    """Return the simulations of a policy, in plain MuJoCo or in the compiled graph; see ``simulate``."""
    if not has_jax():
        return [], None
    from sim2real.robots.walking.twin import plain_episodes
    from sim2real.training.networks.policy import Policy

    values = None if identification is None else identification.values
    played = plain_episodes(robot, bundle.runner(None), values, range(len(recordings)), duration_s)
    if played is not None or identification is None:
        return [(states, states) for states in played or []], None
    policy, timing = Policy.from_weights(bundle.weights, bundle.spec), recordings[0].timing
    parameters = plausible_parameters(identification, len(recordings))
    rest = [_rest(robot, recording.episode) for recording in recordings]
    with progress(None, "simulate the same"):
        return patiently(lambda: simulate(robot, policy, parameters, timing, duration_s, rest, node))


def _rest(robot: Robot, episode: Episode) -> np.ndarray:
    """Return the first measured position of each channel ``(channels,)``."""
    fields = dict(named_leaves(episode.outputs[SENSOR]))
    return np.array([float(c.of(np.asarray(fields[c.position])).ravel()[0]) for c in robot.sensor.channels])


def plausible_parameters(identification: Identification, episodes: int) -> list[dict[str, float]]:
    """Return the parameters of each simulation: the estimates for the first one of each episode, then posterior draws.

    The delays are the estimates in all simulations, because the graph is made for these.
    """
    from sim2real.training.environment.draws import draw_robots
    from sim2real.training.environment.variation import VariationConfig

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
) -> tuple[list[tuple[States, States]], Timeline | None]:
    """Simulate the policy from where the robot rested; steps longer than a period of the policy are not drawn.

    After such a hiccup a node makes several steps at once, and the program would have to hold each of them. The ages
    in the gap report show the hiccups on the robot.

    Args:
        parameters: Parameters of each simulation; simulation e is of episode ``e % len(rest)``.
        rest: The measured positions ``(channels,)`` at the start of each episode on the robot.
        scored_node: The node whose states are scored: the world, or the sensor.

    Returns:
        For each simulation the states of the scored node and those of the sensor, and the timelines; empty and None if
        the timing is too short to draw from.
    """
    from sim2real.graph.schedule import draw
    from sim2real.graph.windows import make_room
    from sim2real.robots.servo.world import ServoWorld
    from sim2real.runtime.compiled.graph import CompiledGraph

    # Draw the timelines from the robot's timing. An error must not lose the deployment.
    try:
        computation, hiccups = timing.computation(1.0 / robot.rate_hz)
    except Sim2RealError as error:
        note(f"warning: nothing to compare with: {error.args[0]}")
        return [], None
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

    return [(states(e, scored_node), states(e, SENSOR)) for e in range(count)], timeline


# -- the gap


def age_rows(episodes: Sequence[Episode], timeline: Timeline | None) -> list[Gap]:
    """Return rows of the gap report: the ages of the data that policy and actuator use, on the robot and simulated."""
    rows = []
    for reader in (AGENT, ACTUATOR):
        measured = [input_ages(e, reader) for e in episodes]
        for name in measured[0]:
            ages = [a[name][np.isfinite(a[name])] for a in measured if name in a]
            drawn = None
            if timeline is not None and (reader, name) in timeline.edges:
                drawn = _drawn_ages(timeline, reader, name)
            for label, q in (("p50", 0.5), ("max", 1.0)):
                real = _mean([float(np.quantile(a, q)) for a in ages if a.size])
                simulated = None if drawn is None else float(np.mean(np.quantile(drawn, q, axis=1)))
                rows.append(_gap(f"age_of_{name}_in_{reader}_{label}_s", real, simulated))
    return rows


def _drawn_ages(timeline: Timeline, reader: str, name: str) -> np.ndarray:
    """Return the age of the newest message at each step of drawn timelines, after the first message ``(E, N)`` [s]."""
    edge, vertex = timeline.edges[reader, name], timeline.vertices[reader]
    newest = newest_message(edge, vertex)[:, : int(vertex.count.min())]
    first = int((newest < 0).sum(axis=1).max())
    sent = np.take_along_axis(timeline.vertices[edge.sender].end, newest.clip(0), axis=1)
    return (vertex.start[:, : newest.shape[1]] - sent)[:, first:] / TICKS_PER_S


def _finite(score: Mapping[str, float]) -> dict[str, float | None]:
    """Return None for a score that does not exist, such as the time to a goal that was not reached."""
    return {name: value if math.isfinite(value) else None for name, value in score.items()}


def _gap(quantity: str, real: float | None, simulated: float | None) -> Gap:
    return Gap(quantity, real, simulated)


def _mean(values: list[float | None]) -> float | None:
    present = [v for v in values if v is not None]
    return float(np.mean(present)) if present else None
