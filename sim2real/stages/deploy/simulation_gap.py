"""A deployment beside simulations of the same policy: scores, ages of the data, and the gap between both."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, Gap, Scores
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import newest_message
from sim2real.installation import has_jax
from sim2real.log.session import input_ages
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, WORLD
from sim2real.robots.robot import Robot, as_columns, as_sent
from sim2real.stages.terminal.console import progress
from sim2real.stages.terminal.interruption import patiently

if TYPE_CHECKING:
    from sim2real.stages.deploy.simulations import States

Score = Callable[[np.ndarray, Mapping[str, np.ndarray]], dict[str, float]]
"""See ``RobotTask.score``."""


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
    # Take the states of the robot's episodes.
    use_truth = all(r.true_states() is not None for r in recordings)
    real = [_states(recording, robot, use_truth) for recording in recordings]

    # Simulate the same policy, in plain MuJoCo or in the compiled graph.
    simulated, timeline = None, None
    values = None if identification is None else identification.values
    trials = list(range(len(recordings)))
    played = None
    if has_jax():
        from sim2real.robots.walking.twin import plain_episodes  # JAX is in its robot

        played = plain_episodes(robot, bundle.runner(None), values, trials, duration_s)
    if played is not None:
        simulated = [(states, states) for states in played]
    elif identification is not None and has_jax():
        from sim2real.stages.deploy.simulations import plausible_parameters, simulate  # JAX programs
        from sim2real.training.networks.policy import Policy

        policy = Policy.from_weights(bundle.weights, bundle.spec)
        parameters = plausible_parameters(identification, len(recordings))
        node = WORLD if use_truth else SENSOR
        rest = [_rest(robot, recording.episode) for recording in recordings]
        with progress(None, "simulate the same"):
            simulated, timeline = patiently(
                lambda: simulate(robot, policy, parameters, recordings[0].timing, duration_s, rest, node)
            )
    scored = None if simulated is None else [states for states, _ in simulated]
    measured = [] if simulated is None else [states for _, states in simulated]

    # Compare scores and ages. The page shows the first simulation of each episode.
    scores, gap = _scored(robot.task.score, real, scored)
    gap += _age_rows([r.episode for r in recordings], timeline)
    columns = [{"t": t, **states} for t, states in measured[: len(recordings)]]
    columns += [{}] * (len(recordings) - len(columns))
    return Deployment(scores, tuple(gap), dict(robot.units), tuple(columns), tuple(recordings))


def _states(recording: Recording, robot: Robot, use_truth: bool) -> States:
    """Return times [s] and columns of an episode on the robot: true states if they are used, else measured ones."""
    episode = recording.episode
    sent = as_sent(robot, episode.outputs[AGENT], episode.outputs[ACTUATOR])
    if use_truth and (true_states := recording.true_states()) is not None:
        t_s, states = true_states
        return t_s, {**sent, **states}
    return episode.steps[SENSOR].begun_s, {**sent, **_sensed(episode)}


def _sensed(episode: Episode) -> dict[str, np.ndarray]:
    return as_columns(episode.outputs[SENSOR])


def _rest(robot: Robot, episode: Episode) -> np.ndarray:
    """Return the first measured position of each channel ``(channels,)``."""
    fields = dict(named_leaves(episode.outputs[SENSOR]))
    return np.array([float(c.of(np.asarray(fields[c.position])).ravel()[0]) for c in robot.sensor.channels])


def _age_rows(episodes: Sequence[Episode], timeline: Timeline | None) -> list[Gap]:
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


def _scored(
    score: Score, real: Sequence[States], simulated: Sequence[States] | None
) -> tuple[tuple[Scores, ...], list[Gap]]:
    """Return the scores of every episode, and the gap report: means over episodes and over simulations.

    A score is None if it does not exist, such as the time to a goal that was not reached.
    """
    on_robot = [_finite(score(t, s)) for t, s in real]
    in_simulation = [_finite(score(t, s)) for t, s in simulated or []]
    gap = []
    for quantity in on_robot[0]:
        means = [_mean([each[quantity] for each in scores]) for scores in (on_robot, in_simulation)]
        gap.append(_gap(quantity, *means))
    beside = [*in_simulation[: len(real)], *[None] * (len(real) - len(in_simulation))]
    return tuple(Scores(r, s) for r, s in zip(on_robot, beside, strict=True)), gap


def _finite(score: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in score.items()}


def _gap(quantity: str, real: float | None, simulated: float | None) -> Gap:
    return Gap(quantity, real, simulated, None if real is None or simulated is None else real - simulated)


def _mean(values: list[float | None]) -> float | None:
    present = [v for v in values if v is not None]
    return float(np.mean(present)) if present else None
