"""Prepares a training: draws episodes from the identification, the robot's timing and the configured variation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.identification import ROUND_TRIP, Identification, Noise
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.node import TICKS_PER_S
from sim2real.robots.loop import AGENT, DELAY_SPREAD_S, DELAYS, SENSOR, WORLD
from sim2real.robots.nodes import SimSensor
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.robots.training import LoopTask, training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import defaults_of, moving
from sim2real.stages.shared.arguments import in_world_of
from sim2real.stages.train.config import TrainConfig
from sim2real.training.environment.draws import draw_robots, without_default_ranges
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.environment.pushes import Pushes
from sim2real.training.environment.tasks import TrainingTask
from sim2real.training.environment.timelines import RecordedTiming, TimelineDraw, draw_timelines
from sim2real.training.environment.variation import VariationConfig

_MAX_TIMES = 5000
"""Number of drawn times that are kept for figures."""
_COUNT = 1024
"""Number of starts that are drawn for figures, and the approximate number of pushes."""


@dataclass(frozen=True)
class TrainingSetup:
    """The environment of a training.

    Attributes:
        robot: The robot, in the world of the training.
        episodes: The distributions from which episodes are drawn.
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
    spread_s: float = DELAY_SPREAD_S,
) -> TrainingSetup:
    """Make the environment.

    Args:
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        changed: Values of parameters that replace the model's; the nominal model has delays if both are given.
        spread_s: Largest deviation of an episode's delay, for which the graph has room [s].

    Raises:
        Sim2RealError: The identification is of another robot or was not accepted, or its timing is unusable.
    """
    identification = check_identification(robot, config, identification)
    robot = moving(robot, _world(config, identification))

    # Draw parameters and delays.
    has_posterior = identification is not None and identification.posterior is not None
    identified = identification.values if identification and has_posterior else None
    usual_values = robot.nominal() | (identified or {})
    # A data sheet has no delays: the loop has delays only if both have ranges.
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
        recorded = RecordedTiming.of(timing, robot.drive.rate_hz, config.seed, config.vary.pauses)
    delayed = recorded is not None or set(DELAYS) <= set(values)
    nodes, task = training_loop(robot, values, draws, recorded.computation if recorded else {}, delayed, spread_s)
    if recorded:
        recorded.set_transport(nodes)
    noise = _set_noise(cast(SimSensor, nodes[SENSOR]), identification, config)

    # Draw timelines, and compile them into index tables.
    drawn = draw_timelines(nodes, AGENT, config.episode_s, config.timelines, config.seed, recorded)
    graph = CompiledGraph(nodes, AGENT, drawn.timeline, reusable=True)

    # Add starts and pushes.
    if any(start := (config.vary.start_position, config.vary.start_velocity)):
        task.start = start
        jax.eval_shape(task.params, jax.random.key(0))
    pushes = Pushes.of(config.vary, nodes[WORLD], robot.drive.rate_hz)
    curriculum = config.vary.curriculum if config.vary.grows else None
    env = GraphEnvironment(graph, task, drawn.steps, pushes, curriculum, config.vary.follow)
    episodes = _episodes(identification, values, draws, noise, drawn, timing, config)
    episodes = _with_disturbances(episodes, config.vary, task, pushes, config.seed)
    if config.vary.grows and not (episodes.parameters or noise):
        raise UsageError(
            "vary.curriculum needs differences between episodes, and all episodes are equal",
            hint="add --vary.uniform 0.3, --vary.push 1, --vary.start-position 0.2, or train on the identified model",
        )
    return TrainingSetup(robot, values, env, episodes)


# -- the identification


def check_identification(
    robot: RecordedRobot, config: TrainConfig, identification: Identification | None
) -> Identification | None:
    """Return an identification on which to train; None for the nominal model.

    Raises:
        Sim2RealError: It is not accepted, and ``config.force`` is not set; or it is of another robot.
    """
    if config.model == "nominal":
        return None
    if identification is None:
        raise UsageError("training on the identified model needs an identification", hint="--model nominal needs none")
    in_world_of(identification, robot)
    verdict = identification.verdict
    if verdict.status != "accepted" and not config.force:
        reasons = "".join(f"\n  {reason}" for reason in verdict.reasons)
        step = f"{verdict.next}; or " if verdict.next else ""
        raise Sim2RealError(
            f"the identification is not accepted: {verdict.status}{reasons}",
            hint=f"{step}train on it all the same: --force",
        )
    return identification


def timing_of(identification: Identification) -> Timing:
    """Return the timing of the identification's recording; raise a ``Sim2RealError`` if it is missing."""
    if identification.timing is None:
        raise Sim2RealError(
            "the timing of this identification is missing: there is no timing.json beside it",
            hint="name the folder that identify wrote, or run `sim2real identify` again",
        )
    return identification.timing


def _world(config: TrainConfig, identification: Identification | None) -> str | None:
    """Return the world to train in."""
    if identification is None:
        return config.world
    if config.world not in (None, identification.internal.world):
        world = repr(identification.internal.world) if identification.internal.world else "the robot's own"
        raise UsageError(
            f"these parameters are of another world, {world}, than {config.world!r}",
            hint=f"identify with --world {config.world}, or train with --model nominal",
        )
    return identification.internal.world


def _replaced(values: Mapping[str, float], changed: Mapping[str, float]) -> dict[str, float]:
    """Return the model's values, some of them replaced."""
    available = dict.fromkeys([*values, *DELAYS])
    if unknown := sorted(set(changed) - set(available)):
        raise UsageError(f"there is no parameter {unknown[0]!r}. Available: {', '.join(available)}")
    replaced = {**values, **changed}
    delays = set(DELAYS) & set(replaced)
    if len(delays) == 1 and delays & set(changed):
        raise UsageError(f"only {delays.pop()!r} was given: a loop has {' and '.join(DELAYS)}")
    return replaced


# -- the distributions of episodes, for figures and tables


def _set_noise(sensor: SimSensor, identification: Identification | None, config: TrainConfig) -> tuple[Noise, ...]:
    """Give the simulated sensor the noise of the log; return the noise.

    Readings that no log determines, such as the orientation of a robot in a stand, keep the robot's nominal noise. So
    do offsets, which are constant in a log.
    """
    factor = config.vary.noise
    if identification is None or not identification.noise or not factor:
        return ()
    nominal = {n.field: n for n in sensor.noise}
    logged = {n.field: n for n in identification.noise}
    offsets = {field: n.offset for field, n in nominal.items()}
    sensor.noise = (
        *(
            replace(
                n,
                deviation=factor * n.deviation,
                resolution=factor * n.resolution,
                offset=factor * max(n.offset, offsets.get(field, 0.0)),
            )
            for field, n in logged.items()
        ),
        *(n for field, n in nominal.items() if field not in logged),
    )
    return sensor.noise


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
        Varied(n, p.unit, values[n], p.low95, p.high95, p.state == "not determined")
        if (p := estimates.get(n)) is not None
        else Varied(n, "", values[n])
        for n in columns
    ]
    if delays := [n for n in DELAYS if n in draws]:
        trip = estimates.get(ROUND_TRIP)
        columns[ROUND_TRIP] = np.sum([draws[n] for n in delays], axis=0)
        ends = (trip.low95, trip.high95) if trip is not None else (None, None)
        rows.append(Varied(ROUND_TRIP, "s", sum(values[n] for n in delays), *ends))

    # Computation times of each node, on the robot if they were recorded.
    drawn_s = {
        n: ((v.end - v.start)[np.arange(v.start.shape[1]) < v.count[:, None]] / TICKS_PER_S)
        for n, v in drawn.timeline.vertices.items()
        if identification is not None and timing is not None and n in timing.steps_s
    }
    widens = config.vary.misfit and not config.vary.uniform
    return Episodes(
        parameters=tuple(rows),
        widening=identification.posterior.widening if identification and identification.posterior and widens else 1.0,
        noise=noise,
        timelines=config.timelines,
        cut=drawn.cut,
        again=drawn.redrawn,
        longest_pause_s=drawn.longest_pause_s,
        draws={n: np.asarray(d, np.float64) for n, d in columns.items()},
        drawn_s={n: np.asarray(s, np.float64)[:_MAX_TIMES] for n, s in drawn_s.items()},
    )


def _with_disturbances(
    episodes: Episodes, vary: VariationConfig, task: TrainingTask, pushes: Pushes | None, seed: int
) -> Episodes:
    """Return the episodes' distributions with pushes and starts, at the end of the curriculum."""
    # Scale parameters as at the end of the curriculum.
    share = vary.curriculum[1]
    last = jnp.float32(share) if vary.grows else None
    k_push, k_start = jax.random.split(jax.random.key(seed))
    draws = {p.name: p.value + share * (episodes.draws[p.name] - p.value) for p in episodes.parameters}

    # Draw starts and pushes as training does.
    added: dict[str, tuple[str, jax.Array]] = {}
    if isinstance(task, LoopTask) and any(task.start):
        offsets = jax.vmap(lambda key: task.offsets(key, last))(jax.random.split(k_start, _COUNT))
        for name, unit, values in zip(("position", "velocity"), ("rad", "rad/s"), offsets, strict=True):
            added |= {f"start {name}": (unit, values)} if values.any() else {}
    if pushes is not None:
        kicks = pushes.kicks(k_push, (round(_COUNT / pushes.chance), len(pushes.sizes)), last)
        added |= {name: (unit, hit[hit != 0.0]) for name, unit, hit in pushes.named(kicks) if hit.any()}
    return replace(
        episodes,
        noise=tuple(replace(n, deviation=share * n.deviation, offset=share * n.offset) for n in episodes.noise),
        parameters=(*episodes.parameters, *(Varied(name, unit, 0.0) for name, (unit, _) in added.items())),
        draws={**draws, **{name: np.ravel(np.asarray(values, np.float64)) for name, (_, values) in added.items()}},
        push_hz=vary.push_hz if pushes is not None else 0.0,
        curriculum=vary.curriculum,
        follow=vary.follow,
    )
