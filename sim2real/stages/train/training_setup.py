"""The environment of a training, from an identification and the robot's timing."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.timing import Timing
from sim2real.errors import UsageError
from sim2real.robots.loop import AGENT, DELAYS, SENSOR, WORLD
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import defaults_of, moving
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.episode_variation import episodes_of, set_noise, set_start, with_disturbances
from sim2real.stages.train.inputs import check_identification, timing_of, world_of
from sim2real.training.environment.draws import draw_robots, without_default_ranges
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.environment.pushes import Pushes
from sim2real.training.environment.timelines import RecordedTiming, draw_timelines


@dataclass(frozen=True)
class TrainingSetup:
    """The environment of a training.

    Attributes:
        robot: The robot, in the world of the training.
        episodes: The distributions that episodes are drawn from.
    """

    robot: Robot
    values: Mapping[str, float]
    env: GraphEnvironment
    episodes: Episodes


def prepare(
    robot: RecordedRobot,
    config: TrainConfig,
    identification: Identification | None = None,
    timing: Timing | None = None,
    changed: Mapping[str, float] | None = None,
) -> TrainingSetup:
    """Make the environment.

    Args:
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        changed: Parameters with other values than the model's; the nominal model has delays if both are among them.

    Raises:
        Sim2RealError: The identification is of another robot or was not accepted, or its timing is unusable.
    """
    identification = check_identification(robot, config, identification)
    robot = moving(robot, world_of(config, identification))

    # Draw parameters and delays.
    has_posterior = identification is not None and identification.posterior is not None
    identified = identification.values if identification and has_posterior else None
    usual_values = robot.nominal() if identified is None else robot.model.unidentified() | identified
    # A data sheet has no delays: ranges of both give the loop delays.
    ranged = {n: sum(config.vary.range[n]) / 2 for n in DELAYS if n in config.vary.range and n not in usual_values}
    values = _replaced(usual_values, {**ranged, **(changed or {})})
    rng = np.random.default_rng(config.seed)
    vary, usual = config.vary, defaults_of(robot).train.vary
    vary = vary if identified is None else without_default_ranges(vary, usual, identified)
    draws = draw_robots(values, identification, vary, config.randomise, rng)
    draws = {n: d for n, d in draws.items() if n not in (changed or ())}

    # Make the nodes, with the robot's computation times, transport times and noise.
    recorded = None
    if identification is not None:
        timing = timing or timing_of(identification)
        recorded = RecordedTiming.of(timing, robot.rate_hz, config.seed, config.vary.pauses)
    delayed = recorded is not None or set(DELAYS) <= set(values)
    nodes, task = robot.training(values, draws, recorded.computation if recorded else {}, delayed)
    if recorded:
        recorded.set_transport(nodes)
    noise = set_noise(nodes[SENSOR], identification, config)

    # Draw timelines, and compile them into index tables.
    drawn = draw_timelines(nodes, AGENT, config.episode_s, config.timelines, config.seed, recorded)
    graph = CompiledGraph(nodes, AGENT, drawn.timeline, reusable=True)

    # Add starts and pushes.
    set_start(task, config)
    pushes = Pushes.of(config.vary, nodes[WORLD], robot.rate_hz)
    curriculum = config.vary.curriculum if config.vary.grows else None
    env = GraphEnvironment(graph, task, drawn.steps, pushes, curriculum, config.vary.follow)
    episodes = episodes_of(identification, values, draws, noise, drawn, timing, config)
    episodes = with_disturbances(episodes, config.vary, task, pushes, config.seed)
    if config.vary.grows and not (episodes.parameters or noise):
        raise UsageError(
            "vary.curriculum needs differences between episodes, and all episodes are equal",
            hint="add --vary.uniform 0.3, --vary.push 1, --vary.start-position 0.2, or train on the identified model",
        )
    return TrainingSetup(robot, values, env, episodes)


def _replaced(values: Mapping[str, float], changed: Mapping[str, float]) -> dict[str, float]:
    """Return the model's values with others in place of some."""
    available = dict.fromkeys([*values, *DELAYS])
    if unknown := sorted(set(changed) - set(available)):
        raise UsageError(f"there is no parameter {unknown[0]!r}. Available: {', '.join(available)}")
    replaced = {**values, **changed}
    delays = set(DELAYS) & set(replaced)
    if len(delays) == 1 and delays & set(changed):
        raise UsageError(f"only {delays.pop()!r} was given: a loop has {' and '.join(DELAYS)}")
    return replaced
