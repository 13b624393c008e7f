"""The table of a deployment's episodes: scores on the robot and of the same policy in simulation, lateness, pauses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, EpisodeRow, mean
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, named_leaves
from sim2real.installation import has_jax
from sim2real.robots.loop import ACTUATOR, AGENT, DELAYS, SENSOR, WORLD
from sim2real.robots.messages import States, Trials, as_columns, as_sent
from sim2real.robots.robot import Robot
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently

_MIN_SIMULATIONS, _MIN_PER_EPISODE = 32, 8
_LATENESS_PERIODS = 0.1
"""A step is late if it takes longer than the longest of training by this share of the policy's period."""


def compare(
    robot: Robot,
    recordings: Sequence[Recording],
    bundle: Bundle,
    identification: Identification | None,
    duration_s: float,
    blend_s: float = 0.0,
) -> Deployment:
    """Return the table of a deployment's episodes: scores on the robot and in simulation, late steps and pauses.

    Scores on both sides use true states if every recording has them, else measured states.

    Args:
        identification: Parameters of the simulations; None: no simulation, except for a walking robot, which then has
            nominal values. The first simulation of each episode has the estimates, the others have draws from the
            posterior.
        duration_s: Length of a simulation [s].
        blend_s: Time in which the action grew from 0 to the policy's on the robot [s].
    """
    use_truth = all(r.true_states() is not None for r in recordings)
    node = WORLD if use_truth else SENSOR
    pairs = _simulated(robot, recordings, bundle, identification, duration_s, node, blend_s)
    count, rows = len(recordings), []
    for i, recording in enumerate(recordings):
        real = _finite(robot.task.score(*_recorded(recording, robot, use_truth)))
        # Simulation e belongs to episode e % count.
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
        # A slightly late step is no pause: the node returns to its schedule.
        gaps_s = np.diff(steps.begun_s)
        if gaps_s.size:
            period_s = float(np.median(gaps_s))
            lost_s.append(float(np.sum(gaps_s[gaps_s >= 2.0 * period_s] - period_s)))
    return max(lost_s)


def _recorded(recording: Recording, robot: Robot, use_truth: bool) -> States:
    """Return the states of an episode on the robot: true states if ``use_truth``, else measured ones."""
    outputs, truth = recording.episode.outputs, recording.true_states() if use_truth else None
    sent = as_sent(robot.drive.command, outputs[AGENT], outputs[ACTUATOR])
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
    blend_s: float = 0.0,
) -> list[tuple[States, States]]:
    """Return the simulations of a policy, see ``Robot.simulated``; empty without parameters, or usual step times."""
    if not has_jax():
        return []
    if identification is not None:
        parameters = plausible_parameters(identification, len(recordings))
    elif set(DELAYS) <= set(nominal := robot.nominal()):
        parameters = [nominal] * len(recordings)
    else:
        return []
    # An error in the simulation must not lose the deployment.
    try:
        computation, hiccups = recordings[0].timing.computation(1.0 / robot.drive.rate_hz)
        rest = [_rest(robot, recording.episode) for recording in recordings]
        with progress(None, "simulate the same"):
            trials = Trials(parameters, computation, rest, duration_s, node, blend_s)
            pairs = patiently(lambda: robot.simulated(bundle, trials))
    except Sim2RealError as error:
        note(f"warning: nothing to compare with: {error.args[0]}")
        return []
    if hiccups:
        counts = ", ".join(f"{count} of {name}" for name, count in hiccups.items())
        note(f"the simulation omits steps that took longer than a period of the policy: {counts}")
    return pairs


def _rest(robot: Robot, episode: Episode) -> np.ndarray:
    """Return the first measured position of each channel ``(channels,)``."""
    fields = dict(named_leaves(episode.outputs[SENSOR]))
    return np.array([float(c.of(np.asarray(fields[c.position])).ravel()[0]) for c in robot.drive.channels])


def plausible_parameters(identification: Identification, episodes: int) -> list[dict[str, float]]:
    """Return the parameters of each simulation: the estimates for the first one of each episode, then posterior draws.

    All simulations have the estimated delays, for which the graph is made.
    """
    from sim2real.training.environment.draws import draw_robots
    from sim2real.training.environment.variation import VariationConfig

    draws = draw_robots(identification.values, identification, VariationConfig(), 1.0, np.random.default_rng(0))
    names = [p.name for p in identification.parameters if p.kind == "dynamics" and p.name in draws]
    count = max(math.ceil(_MIN_SIMULATIONS / episodes), _MIN_PER_EPISODE) * episodes - episodes
    estimates = dict(identification.values)
    return [estimates] * episodes + [estimates | {n: float(draws[n][i]) for n in names} for i in range(count)]


def _finite(score: Mapping[str, float]) -> dict[str, float | None]:
    """Return None for a score that does not exist, such as the time to a goal that was not reached."""
    return {name: value if math.isfinite(value) else None for name, value in score.items()}
