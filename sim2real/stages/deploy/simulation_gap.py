"""What happened on the robot beside the same policy in simulation: scores, and the gap between them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.deployment import Deployment, Gap, Scores
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import newest_message
from sim2real.log.ages import input_ages
from sim2real.robots.contract import Robot
from sim2real.robots.score_columns import as_columns, as_sent
from sim2real.runtime.compilation.bursts import make_room
from sim2real.runtime.compilation.compiled import CompiledGraph
from sim2real.stages.deploy.trajectories import courses
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.train.environment.draws import draw_robots
from sim2real.train.environment.variation import VariationConfig

_SIMULATIONS, _OF_EACH = 32, 8
"""Simulations at least, in all and of each episode."""
States = tuple[np.ndarray, dict[str, np.ndarray]]
"""Times ``(N,)`` [s], and columns: states ``(N,)``, and what was sent, once a step."""


def compare(
    robot: Robot,
    recordings: Sequence[Recording],
    policy: Any,
    found: Identification | None,
    duration_s: float,
) -> Deployment:
    """Return how deployments went, beside simulations of the same policy.

    What is compared is of one kind: scores of true states with those of true ones, where all are known; everything
    else, and what is drawn, is what sensors said beside what they would say.

    Args:
        policy: The policy that ran.
        found: What to simulate with; None: nothing is simulated. The first simulation of each deployment has the
            estimates, the others parameters drawn from what the recordings leave open.
        duration_s: How long to simulate [s].
    """
    known = all(r.true_states() is not None for r in recordings)
    real = [_states(recording, robot, known) for recording in recordings]
    seen = robot.roles.world if known else robot.roles.sensor
    robots = None if found is None else _plausible(found, len(recordings))
    with progress(None, "simulate the same"):
        simulated, timeline = patiently(
            lambda: _simulate(robot, policy, robots, recordings[0].timing, duration_s, len(recordings), seen)
        )
    scored, measured = (None, []) if simulated is None else ([s for s, _ in simulated], [m for _, m in simulated])
    episodes, gap = _scored(robot, real, scored)
    gap += _age_rows(robot, [r.episode for r in recordings], timeline)
    columns = [{"t": t, **states} for t, states in measured[: len(recordings)]]
    columns += [{}] * (len(recordings) - len(columns))
    sensed = [(r.episode.steps[robot.roles.sensor].begun_s, _sensed(robot, r.episode)) for r in recordings]
    went = courses(sensed, measured, robot.units)
    return Deployment(episodes, tuple(gap), dict(robot.units), tuple(columns), tuple(recordings), courses=went)


def _states(recording: Recording, robot: Robot, known: bool) -> States:
    """Return times [s] and states of a deployment: the true ones where all are ``known``, else what was measured."""
    episode = recording.episode
    sent = as_sent(robot, episode.outputs[robot.roles.supervisor], episode.outputs[robot.roles.actuator])
    if known and (true := recording.true_states()) is not None:
        t_s, states = true
        return t_s, {**sent, **states}
    return episode.steps[robot.roles.sensor].begun_s, {**sent, **_sensed(robot, episode)}


def _sensed(robot: Robot, episode: Episode) -> dict[str, np.ndarray]:
    return as_columns(episode.outputs[robot.roles.sensor])


def _simulate(
    robot: Robot,
    policy: Any,
    robots: Sequence[Mapping[str, float]] | None,
    timing: Timing,
    duration_s: float,
    episodes: int,
    seen: str,
) -> tuple[list[tuple[States, States]] | None, Timeline | None]:
    """Return times [s] and states of the same policy in simulation, from rest, on timelines like the robot's.

    ``robots`` are the parameters of each simulation. ``seen`` says which states the first are: those of the world, or
    as the sensor measures them, as late as on the robot; the second are always the sensor's.
    Steps that took longer than a period of the policy are left out: hiccups, after which it would make several steps at
    once, each of which the program would have to hold. What they did on the robot, the ages in the gap report tell.
    None and None where there is nothing to simulate with.
    """
    if robots is None:
        return None, None
    try:
        computation, hiccups = timing.computation(1.0 / robot.rate_hz)
    except Sim2RealError as error:  # the robot has run: what it did must not be lost
        note(f"warning: nothing to compare with: {error.args[0]}")
        return None, None
    if hiccups:
        left = ", ".join(f"{count} of {name}" for name, count in hiccups.items())
        note(f"the simulation leaves out steps that took longer than a period of the policy: {left}")
    nodes, _ = robot.training(robots[0], {}, computation, True)
    count = len(robots)
    timeline = draw(nodes, duration_s, count, 0)
    make_room(nodes, timeline)
    graph = CompiledGraph(nodes, robot.roles.supervisor, timeline)
    # Each deployment's own trial in turn: its simulation has the same to do.
    trials = [robot.simulation_params(values, policy, e % episodes) for e, values in enumerate(robots)]
    params = jax.tree_util.tree_map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trials)
    recorded = tuple({seen, robot.roles.sensor, robot.roles.supervisor, robot.roles.actuator})

    def one(eps: jax.Array, params: Any) -> Any:
        return graph.rollout(graph.init(jax.random.key(0), params, eps=eps), record=recorded)[1]

    records = jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(one))(np.arange(count), params))
    kinds = (seen, robot.roles.sensor)
    pairs = [tuple(_run(graph, records, robot, e, kind) for kind in kinds) for e in range(count)]
    return [(scored, measured) for scored, measured in pairs], timeline


def _plausible(found: Identification, episodes: int) -> list[dict[str, float]]:
    """Return parameters of simulations: the estimates for the first of each episode, then what recordings leave open.

    Delays are the estimates in all of them, as the graph is made for those.
    """
    drawn = draw_robots(found.values, found, VariationConfig(), 1.0, np.random.default_rng(0))
    own = [p.name for p in found.parameters if p.kind == "dynamics" and p.name in drawn]
    others = range(max(_SIMULATIONS, _OF_EACH * episodes) - episodes)
    return [{**found.values}] * episodes + [{**found.values} | {n: float(drawn[n][i]) for n in own} for i in others]


def _age_rows(robot: Robot, episodes: Sequence[Episode], timeline: Timeline | None) -> list[Gap]:
    """Return rows of the gap table: how old the data were that policy and actuator acted on, on the robot and here."""
    rows = []
    for reader in (robot.roles.supervisor, robot.roles.actuator):
        measured = [input_ages(e, reader) for e in episodes]
        for name in measured[0]:
            ages = [a[name][np.isfinite(a[name])] for a in measured if name in a]
            simulated = None
            if timeline is not None and (reader, name) in timeline.edges:
                simulated = _drawn_ages(timeline, reader, name)
            for label, of in (("p50", 0.5), ("max", 1.0)):
                r = _mean([float(np.quantile(a, of)) for a in ages if a.size])
                s = None if simulated is None else float(np.mean(np.quantile(simulated, of, axis=1)))
                gap = None if r is None or s is None else r - s
                quantity = f"age_of_{name}_in_{reader}_{label}_s"
                rows.append(Gap(quantity, r, s, gap))
    return rows


def _drawn_ages(timeline: Timeline, reader: str, name: str) -> np.ndarray:
    """Return how old the newest message of each step is in drawn timelines [s]; the same steps of all, ``(E, N)``."""
    edge, vertex = timeline.edges[reader, name], timeline.vertices[reader]
    newest = newest_message(edge, vertex)[:, : int(vertex.count.min())]
    first = int((newest < 0).sum(axis=1).max())
    sent = np.take_along_axis(timeline.vertices[edge.sender].end, newest.clip(0), axis=1)
    return (vertex.start[:, : newest.shape[1]] - sent)[:, first:] / TICKS_PER_S


def _run(graph: CompiledGraph, records: Mapping[str, Any], robot: Robot, e: int, seen: str) -> States:
    """Return times [s] and states of one simulation."""

    def sent(node: str) -> dict[str, Any]:
        ran = records[node].seq[e] >= 0
        return {n: np.asarray(leaf)[e][ran] for n, leaf in named_leaves(records[node].output).items()}

    def steps(node: str) -> np.ndarray:
        return records[node].seq[e][records[node].seq[e] >= 0]

    name, vertices = robot.roles.actuator, graph.timeline.vertices
    when = vertices[name].end[e][steps(name)] / TICKS_PER_S
    columns = {**as_sent(robot, sent(robot.roles.supervisor), sent(name)), **as_columns(sent(seen))}
    if seen == robot.roles.world:  # a tick's message is its state at the end
        t_s = (steps(seen) + 1) / graph.nodes[seen].rate
    else:
        t_s = vertices[seen].start[e][steps(seen)] / TICKS_PER_S
    return t_s, {**columns, "t_command": when}


def _scored(
    robot: Robot, real: Sequence[States], simulated: Sequence[States] | None
) -> tuple[tuple[Scores, ...], list[Gap]]:
    """Return the scores of every deployment, and the gap table: means over deployments and over simulations.

    None stands for a score that there is not, such as when a goal was reached that never was.
    """
    on_robot = [_scores(robot, t, s) for t, s in real]
    in_simulation = [_scores(robot, t, s) for t, s in simulated or []]
    gap = []
    for quantity in on_robot[0]:
        r, s = (_mean([score[quantity] for score in scores]) for scores in (on_robot, in_simulation))
        gap.append(Gap(quantity, r, s, None if r is None or s is None else r - s))
    beside = [*in_simulation[: len(real)], *[None] * (len(real) - len(in_simulation))]
    return tuple(Scores(r, s) for r, s in zip(on_robot, beside, strict=True)), gap


def _scores(robot: Robot, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in robot.score(t_s, states).items()}


def _mean(values: list[float | None]) -> float | None:
    there = [v for v in values if v is not None]
    return float(np.mean(there)) if there else None
