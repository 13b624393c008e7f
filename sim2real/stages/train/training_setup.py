"""The environment of a training, from an identification and the robot's timing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.estimation.noise import Noise
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.run.run_folder import newest
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.node import TICKS_PER_S, BaseNode
from sim2real.policy.contract import PolicyContract
from sim2real.robots.contract import Robot
from sim2real.robots.control_loop.loop import DELAYS
from sim2real.robots.control_loop.simulated_devices import SimSensor
from sim2real.robots.control_loop.training_task import LoopTask
from sim2real.runtime.compilation.compiled import CompiledGraph
from sim2real.stages.pipeline.find_run import warn_of_stale
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_parameters import check_parameters
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import note
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.episode_variation import with_disturbances
from sim2real.train.environment.draws import draw_robots
from sim2real.train.environment.graph_environment import GraphEnvironment, TrainingTask
from sim2real.train.environment.pushes import Pushes
from sim2real.train.environment.timelines import RecordedTiming, TimelineDraw, draw_timelines

_MAX_TIMES = 5000
"""Number of times that are kept for pictures."""


@dataclass(frozen=True)
class TrainingSetup:
    """The environment of a training.

    Attributes:
        robot: The robot, in the world of the training.
        values: Parameters by name.
        env: One copy.
        episodes: The distributions that episodes are drawn from.
    """

    robot: Robot
    values: Mapping[str, float]
    env: GraphEnvironment
    episodes: Episodes


def prepare(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None = None,
    timing: Timing | None = None,
    changed: Mapping[str, float] | None = None,
    robot: Robot | None = None,
) -> TrainingSetup:
    """Make the environment.

    Args:
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        changed: Parameters with other values than the model's; the nominal model has delays if both are among them.
        robot: The pipeline's robot in its world, changed by the caller; default: unchanged.

    Raises:
        UsageError: The configuration names the identified model without an identification, or another world, or a
            parameter is unknown.
        Sim2RealError: The identification is of another robot or was not accepted, or its timing is unusable.
    """
    identification = _checked(pipeline, config, identification)
    robot = robot or moving_robot(pipeline, _world(config, identification))

    # Draw parameters and delays.
    has_posterior = identification is not None and identification.posterior is not None
    values = _replaced(identification.values if identification and has_posterior else robot.nominal(), changed or {})
    rng = np.random.default_rng(config.seed)
    draws = draw_robots(values, identification, config.vary, config.randomise, rng)
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
    noise = _set_noise(nodes[robot.roles.sensor], identification, config)

    # Draw timelines, and compile them into index tables.
    drawn = draw_timelines(nodes, robot.roles.supervisor, config.episode_s, config.timelines, config.seed, recorded)
    graph = CompiledGraph(nodes, robot.roles.supervisor, drawn.timeline, reusable=True)

    # Add starts and pushes.
    _set_start(task, config)
    pushes = Pushes.of(config.vary, nodes[robot.roles.world], robot.rate_hz)
    env = GraphEnvironment(graph, task, drawn.steps, pushes, config.vary.curriculum if config.vary.grows else None)
    episodes = _episodes(identification, values, draws, noise, drawn, timing, config)
    episodes = with_disturbances(episodes, config.vary, task, pushes, config.seed)
    if config.vary.grows and not (episodes.parameters or noise):
        raise UsageError(
            "vary.curriculum needs differences between episodes, and all episodes are equal",
            hint="add --vary.uniform 0.3, --vary.push 1, --vary.start-position 0.2, or train on the identified model",
        )
    return TrainingSetup(robot, values, env, episodes)


def _checked(pipeline: Pipeline, config: TrainConfig, identification: Identification | None) -> Identification | None:
    """Return an identification that may be trained on; None for the nominal model."""
    if config.model == "nominal":
        return None
    if identification is None:
        raise UsageError("training on the identified model needs an identification", hint="--model nominal needs none")
    check_parameters(identification, pipeline)
    require_accepted(identification, config)
    return identification


def _set_start(task: LoopTask, config: TrainConfig) -> None:
    """Give the task the configured offsets of an episode's start."""
    start = (config.vary.start_position, config.vary.start_velocity)
    if not any(start):
        return
    task.start = start
    jax.eval_shape(task.params, jax.random.key(0))


def timing_of(identification: Identification) -> Timing:
    """Return the timing of the identification's recording, otherwise raise a ``Sim2RealError``."""
    if identification.timing is None:
        raise Sim2RealError(
            "the timing of this identification is missing: there is no timing.json beside it",
            hint="name the folder that identify wrote, or run `sim2real identify` again",
        )
    return identification.timing


def _replaced(values: Mapping[str, float], changed: Mapping[str, float]) -> dict[str, float]:
    """Return the model's values with others in place of some.

    Raises:
        UsageError: One is unknown, or only one of two delays is given.
    """
    available = dict.fromkeys([*values, *DELAYS])
    if unknown := sorted(set(changed) - set(available)):
        raise UsageError(f"there is no parameter {unknown[0]!r}. Available: {', '.join(available)}")
    replaced = {**values, **changed}
    delays = set(DELAYS) & set(replaced)
    if len(delays) == 1 and delays & set(changed):
        raise UsageError(f"only {delays.pop()!r} was given: a loop has {' and '.join(DELAYS)}")
    return replaced


def require_accepted(identification: Identification, config: TrainConfig) -> None:
    """Raise a ``Sim2RealError`` for an identification that is not accepted, unless ``config.force`` is set."""
    verdict = identification.verdict
    if verdict.status == "accepted" or config.force:
        return
    reasons = "".join(f"\n  {reason}" for reason in verdict.reasons)
    step = f"{verdict.next}, or " if verdict.next else ""
    raise Sim2RealError(
        f"the identification is not accepted: {verdict.status}{reasons}",
        hint=f"{step}train on it all the same: --force",
    )


def _world(config: TrainConfig, identification: Identification | None) -> str | None:
    """Return the world to train in.

    Raises:
        UsageError: The identification is of another world than the configured one.
    """
    if identification is None:
        return config.world
    if config.world not in (None, identification.world):
        world = repr(identification.world) if identification.world else "the robot's own"
        raise UsageError(
            f"these parameters are of another world, {world}, than {config.world!r}",
            hint=f"identify with --world {config.world}, or train with --model nominal",
        )
    return identification.world


def _set_noise(sensor: BaseNode, identification: Identification | None, config: TrainConfig) -> tuple[Noise, ...]:
    """Give the simulated sensor the noise of the log; return it."""
    factor = config.vary.noise
    if identification is None or not identification.noise or not factor:
        return ()
    noise = tuple(
        replace(n, deviation=factor * n.deviation, quantum=factor * n.quantum, bias=factor * n.bias)
        for n in identification.noise
    )
    if not isinstance(sensor, SimSensor):
        note(
            f"readings are exact: {type(sensor).__name__} takes no noise, as "
            "sim2real.robots.control_loop.simulated_devices.SimSensor does"
        )
        return ()
    sensor.noise = noise
    return noise


def _episodes(
    identification: Identification | None,
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    noise: tuple[Noise, ...],
    drawn: TimelineDraw,
    timing: Timing | None,
    config: TrainConfig,
) -> Episodes:
    """Return the distributions of the episodes, with one row for the sum of the delays."""
    # A row for each drawn parameter, with its interval.
    estimates = {p.name: p for p in identification.parameters} if identification is not None else {}
    columns = {n: d for n, d in draws.items() if n not in DELAYS}
    rows = [
        Varied(n, p.unit, values[n], p.low95, p.high95, p.verdict == "not identifiable")
        if (p := estimates.get(n)) is not None
        else Varied(n, "", values[n])
        for n in columns
    ]
    if delays := [n for n in DELAYS if n in draws]:
        trip = estimates.get(ROUND_TRIP)
        columns[ROUND_TRIP] = np.sum([draws[n] for n in delays], axis=0)
        ends = (trip.low95, trip.high95) if trip is not None else (None, None)
        rows.append(Varied(ROUND_TRIP, "s", sum(values[n] for n in delays), *ends))

    # Computation times of each node, drawn and recorded.
    drawn_s = {
        n: ((v.end - v.start)[np.arange(v.start.shape[1]) < v.count[:, None]] / TICKS_PER_S)
        for n, v in drawn.timeline.vertices.items()
    }
    recorded_s = {} if identification is None or timing is None else timing.steps_s
    widens = config.vary.misfit and not config.vary.uniform
    return Episodes(
        parameters=tuple(rows),
        widening=(identification.widening if identification and widens else None) or 1.0,
        noise=noise,
        timelines=config.timelines,
        cut=drawn.cut,
        again=drawn.redrawn,
        longest_pause_s=drawn.longest_pause_s,
        draws={n: np.asarray(d, np.float64) for n, d in columns.items()},
        recorded_s={n: np.asarray(s, np.float64)[:_MAX_TIMES] for n, s in recorded_s.items()},
        drawn_s={n: np.asarray(s, np.float64)[:_MAX_TIMES] for n, s in drawn_s.items() if n in recorded_s},
        off=_deviations(identification, noise),
    )


def _deviations(identification: Identification | None, noise: tuple[Noise, ...]) -> dict[str, np.ndarray]:
    """Return the measurements minus the predictions of the identified model, for columns with predictions."""
    deviations = {}
    for n in noise:
        measured, model = f"{n.column}_measured", f"{n.column}_identified"
        if identification is not None and {measured, model} <= set(identification.samples):
            values = np.asarray(identification.samples[measured] - identification.samples[model], np.float64)
            deviations[n.column] = values[np.isfinite(values)][:_MAX_TIMES]
    return deviations


def find_parameters(
    pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None
) -> tuple[Path | None, Path | None]:
    """Return the identification to train on, None for the nominal model, and the run folder to write into.

    Args:
        run_dir: Run folder; None: the newest one with an identification.
    """
    if config.model == "nominal":
        return None, run_dir
    if config.parameters is not None:
        return Path(config.parameters), run_dir
    identified = warn_of_stale(newest(root, pipeline.name, "identify", run_dir))
    return identified.output("parameters"), run_dir or identified.run_dir


def contract_of(
    robot: Robot, task: TrainingTask, values: Mapping[str, float], episodes: Episodes | None = None
) -> PolicyContract:
    """Return the contract of a policy: observation, action, and the delays of its training.

    Args:
        values: Parameters by name.
    """
    return PolicyContract(
        observation=robot.agent.observation,
        action=tuple(
            replace(term, low=float(low), high=float(high))
            for term, low, high in zip(robot.agent.action, task.action_low, task.action_high, strict=True)
        ),
        rate_hz=robot.rate_hz,
        delays_s={n: v for n, v in values.items() if n.endswith("_delay")},
        trained_s={} if episodes is None else _trained(values, episodes),
        limits=dict(robot.agent.limits),
        hashes={},
    )


def _trained(values: Mapping[str, float], episodes: Episodes) -> dict[str, tuple[float, float]]:
    """Return the range of the round trip over the episodes, and the 1 and 99 % quantiles of each node's steps [s]."""
    trained: dict[str, tuple[float, float]] = {}
    if set(DELAYS) <= set(values):
        trips = np.append(episodes.draws.get(ROUND_TRIP, []), sum(values[n] for n in DELAYS))
        trained[ROUND_TRIP] = (float(trips.min()), float(trips.max()))
    for node, took_s in episodes.drawn_s.items():
        trained[node] = (float(np.quantile(took_s, 0.01)), float(np.quantile(took_s, 0.99)))
    return trained
