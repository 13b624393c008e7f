"""What a training runs on: the environment, made of what was identified and of how long everything took."""

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
from sim2real.train.environment.timelines import Drawn, Recorded, draw_timelines

_SHOWN = 5000
"""So many times are kept for pictures."""


@dataclass(frozen=True)
class Prepared:
    """Everything that a training needs.

    Attributes:
        robot: The robot, in the world that is trained in.
        values: Parameters by name.
        env: One copy of the environment.
        episodes: What episodes are drawn from.
    """

    robot: Robot
    values: Mapping[str, float]
    env: GraphEnvironment
    episodes: Episodes


def prepare(
    pipeline: Pipeline,
    config: TrainConfig,
    found: Identification | None = None,
    timing: Timing | None = None,
    changed: Mapping[str, float] | None = None,
    robot: Robot | None = None,
) -> Prepared:
    """Make the environment.

    Args:
        config: What to train on, and in what episodes differ.
        found: What identify found; the nominal model needs none.
        timing: How long everything takes on the robot; default: as in the recording that was identified from. The
            nominal model has no delays.
        changed: Parameters with other values than the model's; the nominal model has delays where both are among them.
        robot: The pipeline's robot in its world, with changes of its own; default: without.

    Raises:
        UsageError: When the identified model is asked for without an identification, in another world, or a parameter
            is not known.
        Sim2RealError: When the identification is of another robot or was not accepted, or its timing cannot be trained
            with.
    """
    if config.model == "nominal":
        found = None
    elif found is None:
        raise UsageError("training on the identified model needs an identification", hint="--model nominal needs none")
    else:
        check_parameters(found, pipeline)
        require_accepted(found, config)
    robot = robot or moving_robot(pipeline, _world(config, found))
    values = _changed(robot.nominal() if found is None or found.posterior is None else found.values, changed or {})
    rng = np.random.default_rng(config.seed)
    draws = draw_robots(values, found, config.vary, config.randomise, rng)
    draws = {n: d for n, d in draws.items() if n not in (changed or ())}
    recorded = None
    if found is not None:
        timing = timing or timing_of(found)
        recorded = Recorded.of(timing, robot.rate_hz, config.seed, config.vary.pauses)
    delayed = recorded is not None or set(DELAYS) <= set(values)
    nodes, task = robot.training(values, draws, recorded.computation if recorded else {}, delayed)
    if recorded:
        recorded.transport_to(nodes)
    noise = _disturb(nodes[robot.roles.sensor], found, config)
    drawn = draw_timelines(nodes, robot.roles.supervisor, config.episode_s, config.timelines, config.seed, recorded)
    graph = CompiledGraph(nodes, robot.roles.supervisor, drawn.timeline, reusable=True)
    _move_start(task, config)
    pushes = Pushes.of(config.vary, nodes[robot.roles.world], robot.rate_hz)
    env = GraphEnvironment(graph, task, drawn.steps, pushes, config.vary.curriculum if config.vary.grows else None)
    episodes = _episodes(found, values, draws, noise, drawn, timing, config)
    episodes = with_disturbances(episodes, config.vary, task, pushes, config.seed)
    if config.vary.grows and not (episodes.parameters or noise):
        raise UsageError(
            "vary.curriculum lets episodes differ more and more, and nothing differs between them",
            hint="add --vary.uniform 0.3, --vary.push 1, --vary.start-position 0.2, or train on the identified model",
        )
    return Prepared(robot, values, env, episodes)


def _move_start(task: TrainingTask, config: TrainConfig) -> None:
    """Let episodes start where the configuration says.

    Raises:
        UsageError: The task, or its world, does not know how.
    """
    start = (config.vary.start_position, config.vary.start_velocity)
    if not any(start):
        return
    if not isinstance(task, LoopTask):
        raise UsageError(
            f"the start of a {type(task).__name__} cannot be moved", hint="leave out --vary.start-*, or use a LoopRobot"
        )
    task.start = start
    jax.eval_shape(task.params, jax.random.key(0))


def timing_of(found: Identification) -> Timing:
    """Return the timing of the recording that was identified from.

    Raises:
        Sim2RealError: When it is not there.
    """
    if found.timing is None:
        raise Sim2RealError(
            "this identification does not say how long the robot's steps take: its timing.json is not beside it",
            hint="name the folder that identify wrote, or run `sim2real identify` again",
        )
    return found.timing


def _changed(values: Mapping[str, float], changed: Mapping[str, float]) -> dict[str, float]:
    """Return the model's values with others in place of some.

    Raises:
        UsageError: When one is not known, or only one of two delays is given.
    """
    known = dict.fromkeys([*values, *DELAYS])
    if unknown := sorted(set(changed) - set(known)):
        raise UsageError(f"there is no parameter {unknown[0]!r}. Available: {', '.join(known)}")
    made = {**values, **changed}
    given = set(DELAYS) & set(made)
    if len(given) == 1 and given & set(changed):
        raise UsageError(f"only {given.pop()!r} was given: a loop has {' and '.join(DELAYS)}")
    return made


def require_accepted(found: Identification, config: TrainConfig) -> None:
    """Refuse an identification that is not accepted, unless that was asked for.

    Raises:
        Sim2RealError: With the reasons, and what to do next.
    """
    if found.verdict.status == "accepted" or config.force:
        return
    reasons = "".join(f"\n  {reason}" for reason in found.verdict.reasons)
    again = f"{found.verdict.next}, or " if found.verdict.next else ""
    raise Sim2RealError(
        f"the identification is not accepted: {found.verdict.status}{reasons}",
        hint=f"{again}train on it all the same: --force",
    )


def _world(config: TrainConfig, found: Identification | None) -> str | None:
    """Return the world to train in.

    Raises:
        UsageError: When another one is asked for than was identified.
    """
    if found is not None and config.world not in (None, found.world):
        own = repr(found.world) if found.world else "the robot's own"
        raise UsageError(
            f"these parameters are of another world, {own}, than {config.world!r}",
            hint=f"identify with --world {config.world}, or train with --model nominal",
        )
    return config.world if found is None else found.world


def _disturb(sensor: BaseNode, found: Identification | None, config: TrainConfig) -> tuple[Noise, ...]:
    """Give the simulated sensor the noise that the log shows; return it."""
    factor = config.vary.noise
    if found is None or not found.noise or not factor:
        return ()
    noise = tuple(
        replace(n, deviation=factor * n.deviation, quantum=factor * n.quantum, bias=factor * n.bias)
        for n in found.noise
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
    found: Identification | None,
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    noise: tuple[Noise, ...],
    drawn: Drawn,
    timing: Timing | None,
    config: TrainConfig,
) -> Episodes:
    """Return what episodes are drawn from, with one row for the sum of the delays."""
    known = {p.name: p for p in found.parameters} if found is not None else {}
    shown = {n: d for n, d in draws.items() if n not in DELAYS}
    rows = [
        Varied(n, p.unit, values[n], p.low95, p.high95, p.verdict == "not identifiable")
        if (p := known.get(n)) is not None
        else Varied(n, "", values[n])
        for n in shown
    ]
    if delays := [n for n in DELAYS if n in draws]:
        trip = known.get(ROUND_TRIP)
        shown[ROUND_TRIP] = np.sum([draws[n] for n in delays], axis=0)
        ends = (trip.low95, trip.high95) if trip is not None else (None, None)
        rows.append(Varied(ROUND_TRIP, "s", sum(values[n] for n in delays), *ends))
    taken = {
        n: ((v.end - v.start)[np.arange(v.start.shape[1]) < v.count[:, None]] / TICKS_PER_S)
        for n, v in drawn.timeline.vertices.items()
    }
    recorded = {} if found is None or timing is None else timing.steps_s
    widening = found.widening if found is not None and config.vary.misfit and not config.vary.uniform else None
    return Episodes(
        parameters=tuple(rows),
        widening=widening or 1.0,
        noise=noise,
        timelines=config.timelines,
        cut=drawn.cut,
        again=drawn.again,
        longest_pause_s=drawn.longest_pause_s,
        draws={n: np.asarray(d, np.float64) for n, d in shown.items()},
        recorded_s={n: np.asarray(s, np.float64)[:_SHOWN] for n, s in recorded.items()},
        drawn_s={n: np.asarray(s, np.float64)[:_SHOWN] for n, s in taken.items() if n in recorded},
        off=_off(found, noise),
    )


def _off(found: Identification | None, noise: tuple[Noise, ...]) -> dict[str, np.ndarray]:
    """Return how far measurements lay off the identified model, where the predictions are there."""
    off = {}
    for n in noise:
        measured, model = f"{n.column}_measured", f"{n.column}_identified"
        if found is not None and {measured, model} <= set(found.samples):
            own = np.asarray(found.samples[measured] - found.samples[model], np.float64)
            off[n.column] = own[np.isfinite(own)][:_SHOWN]
    return off


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
    found = warn_of_stale(newest(root, pipeline.name, "identify", run_dir))
    return found.output("parameters"), run_dir or found.run_dir


def contract_of(
    robot: Robot, task: TrainingTask, values: Mapping[str, float], episodes: Episodes | None = None
) -> PolicyContract:
    """Return what a policy of a robot sees and does, and the delays that it is trained with.

    Args:
        task: Its task, with the actions' bounds.
        values: Parameters by name, whose delays the policy is trained with.
    """
    return PolicyContract(
        observation=robot.observation,
        action=tuple(
            replace(term, low=float(low), high=float(high))
            for term, low, high in zip(robot.action, task.action_low, task.action_high, strict=True)
        ),
        rate_hz=robot.rate_hz,
        delays_s={n: v for n, v in values.items() if n.endswith("_delay")},
        trained_s={} if episodes is None else _trained(values, episodes),
        limits=dict(robot.limits),
        hashes={},
    )


def _trained(values: Mapping[str, float], episodes: Episodes) -> dict[str, tuple[float, float]]:
    """Return the shortest and longest round trip of the episodes, and of each node's steps all but 1 % either way."""
    trained: dict[str, tuple[float, float]] = {}
    if set(DELAYS) <= set(values):
        trips = np.append(episodes.draws.get(ROUND_TRIP, []), sum(values[n] for n in DELAYS))
        trained[ROUND_TRIP] = (float(trips.min()), float(trips.max()))
    for node, took_s in episodes.drawn_s.items():
        trained[node] = (float(np.quantile(took_s, 0.01)), float(np.quantile(took_s, 0.99)))
    return trained
