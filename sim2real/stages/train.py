"""Train a policy on the identified model, with the timing that the robot really has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sim2real.artifacts.bundle import Bundle, History
from sim2real.artifacts.files import number
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.manifest import sha256
from sim2real.artifacts.run_folder import StageFolder, newest, open_stage
from sim2real.artifacts.sensitivity import Sensitivity
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.policy.contract import PolicyContract
from sim2real.robots.base import Robot
from sim2real.robots.loop import DELAYS
from sim2real.robots.loop_robot import LoopRobot
from sim2real.runtime.compiled import CompiledGraph
from sim2real.stages.config import TrainConfig
from sim2real.stages.console import note, progress, table
from sim2real.stages.interruption import patiently
from sim2real.stages.parameters import check_parameters, open_identification
from sim2real.stages.pipeline import Pipeline, pipeline_of
from sim2real.stages.robot import moving_robot
from sim2real.stages.sensitivity import TIMELINES, models_of, moves_of, sensitivity, with_room
from sim2real.train.env import GraphEnvironment, TrainingTask
from sim2real.train.networks import Policy
from sim2real.train.ppo import Progress, TrainResult
from sim2real.train.ppo import train as learn

_LONGEST_GAP = 1.25
"""Timelines with a pause between policy steps longer than this many times the median are drawn again."""
_HICCUP = 0.25
"""Steps that took longer than this share of the policy's period on the robot are not drawn from."""
_LEAST_SPREAD, _MOST = 0.02, 2.0
"""Copies differ by at least this share of a parameter, and at most by this factor, however uncertain it is."""
_DRAWS = 1024


def train(
    robot: Robot | Pipeline,
    config: TrainConfig | None = None,
    identification: Identification | None = None,
    timing: Timing | None = None,
) -> tuple[Bundle, dict[str, Any]]:
    """Train a policy.

    Args:
        robot: The robot, or its pipeline.
        config: How; default: that of the pipeline that loaded the robot. The file that it may name is not read.
        identification: What identify found; the nominal model needs none.
        timing: How long everything takes on the robot; default: as in the recording that was identified from. The
            nominal model has no delays.

    Returns:
        The policy with what it expects and promises, and numbers about the training.

    Raises:
        UsageError: When the identified model is asked for without an identification, or in another world.
        Sim2RealError: When the identification is of another robot, or its timing cannot be trained with.
    """
    pipeline = pipeline_of(robot)
    config = config or pipeline.train
    robot, env, values, dropped, redrawn = playground(pipeline, config, identification, timing)
    ppo = replace(config.ppo, eval_steps=env.length + 1)
    with progress(ppo.evaluations, "train (compiling)") as bar:
        result = patiently(lambda: learn(env, ppo, jax.random.key(config.seed), lambda p: _report(bar, p)))
    weak = _sensitivity(pipeline, config, identification, timing, robot, result.best) if config.sensitivity else None
    bundle = Bundle(contract_of(robot, env.task, values), result.best.to_weights(), _history(result), sensitivity=weak)
    about = {
        "model": config.model,
        "success in simulation": f"{result.history['success'].max():.2f} (seed {result.best_seed})",
        "policy steps": int(result.env_steps[-1]) * ppo.num_seeds,
        "policy steps a second": round(result.env_steps_per_s),
        "compile": f"{result.compile_s:.1f} s",
        "train": f"{result.train_s:.1f} s",
        "hiccups left out": dropped,
        "timelines drawn again": redrawn,
    }
    return bundle, about if weak is None else {**about, "what breaks it": weak.said}


def _sensitivity(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None,
    timing: Timing | None,
    robot: Robot,
    policy: Policy,
) -> Sensitivity | None:
    """Return how the policy does where one parameter is wrong; None where nothing says by how much it may be."""
    if config.model == "nominal" or identification is None or not isinstance(robot, LoopRobot):
        return None
    moves = moves_of(identification)
    models = models_of(identification.values, moves)
    wide = with_room(robot, models)
    few = replace(config, timelines=TIMELINES)
    env = playground(pipeline, few, identification, timing, robot=wide).env
    return sensitivity(wide, env, policy, moves, models, config.seed)


class Playground(NamedTuple):
    """What policies are trained in.

    Attributes:
        robot: The robot, in its world.
        env: The graph with its delays as an environment.
        values: Parameter -> what the model has, without an episode's own deviation.
        dropped: Steps that were left out of the timing as hiccups.
        redrawn: Timelines that were drawn again.
    """

    robot: Robot
    env: GraphEnvironment
    values: dict[str, float]
    dropped: int
    redrawn: int


def playground(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None = None,
    timing: Timing | None = None,
    changed: Mapping[str, float] | None = None,
    robot: Robot | None = None,
) -> Playground:
    """Return the environment that a policy is trained in.

    Args:
        pipeline: The robot.
        config: Model, world, timelines, randomisation and seed.
        identification: What identify found; the nominal model needs none.
        timing: How long everything takes; default: as in the recording that was identified from.
        changed: Parameters with other values than the model's; the nominal model has delays where both are among them.
        robot: The pipeline's robot in its world, with changes of its own; default: without.

    Raises:
        UsageError: When the identified model is asked for without an identification, in another world, or a parameter
            is not known.
        Sim2RealError: When the identification is of another robot, or its timing cannot be trained with.
    """
    identified = config.model == "identified"
    if identified and identification is None:
        raise UsageError("training on the identified model needs an identification", hint="--model nominal needs none")
    if identification is not None and identified:
        check_parameters(identification, pipeline)
    robot = robot or moving_robot(pipeline, _world(config, identification if identified else None))
    values, draws = model_values(robot, identification, config)
    if unknown := sorted(set(changed or ()) - {*values, *DELAYS}):
        raise UsageError(
            f"there is no parameter {unknown[0]!r}. Available: {', '.join(dict.fromkeys([*values, *DELAYS]))}"
        )
    values = {**values, **(changed or {})}
    given = set(DELAYS) & set(values)
    if not identified and len(given) == 1:
        raise UsageError(f"only {given.pop()!r} was given: a loop has {' and '.join(DELAYS)}")
    draws = {name: draw for name, draw in draws.items() if name not in (changed or ())}
    computation, dropped = _computation(robot, identification, timing) if identified else ({}, {})
    nodes, task = robot.training(values, draws, computation, identified or bool(given))
    timeline, redrawn = draw_timelines(nodes, robot.roles.supervisor, config)
    env = GraphEnvironment(CompiledGraph(nodes, robot.roles.supervisor, timeline), task)
    return Playground(robot, env, values, sum(dropped.values()), redrawn)


def run(pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Train, and write the policy bundle into a stage folder.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the parameters, or a new one for the nominal model.
    """
    moving_robot(pipeline)  # before anything is read
    path, run_dir = find_parameters(pipeline, config, root, run_dir)
    identification = None if path is None else open_identification(path, pipeline)
    if identification is not None:
        _timing_of(identification)  # without it a folder is not made
    inputs = {} if path is None else {"parameters": path}
    with open_stage(root, pipeline.name, "train", config, inputs, run_dir) as stage:
        bundle, about = train(pipeline, config, identification)
        hashes = {name: sha256(file) for name, file in inputs.items()}
        if identification is not None and identification.logs:
            hashes["log"] = identification.logs[0].sha256
        bundle = replace(bundle, contract=replace(bundle.contract, hashes=hashes))
        for name, file in bundle.save(stage.folder).items():
            stage.output(name, file)
        if bundle.history is not None:
            print(table(*_rows(bundle.history)))
        stage.summary(about)
    return stage.result


def _world(config: TrainConfig, identified: Identification | None) -> str | None:
    """Return the world to train in.

    Raises:
        UsageError: When another one is asked for than was identified.
    """
    if identified is not None and config.world not in (None, identified.world):
        own = repr(identified.world) if identified.world else "the robot's own"
        raise UsageError(
            f"these parameters are of another world, {own}, than {config.world!r}",
            hint=f"identify with --world {config.world}, or train with --model nominal",
        )
    return config.world if identified is None else identified.world


def model_values(
    robot: Robot, identified: Identification | None, config: TrainConfig
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Return the parameters to train on, and draws of the dynamics from their posterior, ``(K,)`` each.

    Draws keep the correlations between parameters. Where the log leaves one open, draws are cut off at half and twice
    its estimate.

    Args:
        robot: The robot, for its nominal parameters.
        identified: What identify found; the nominal model needs none.
        config: Which model, how far copies differ, and the seed.
    """
    if config.model == "nominal" or identified is None or identified.posterior is None:
        return robot.nominal(), {}
    rng = np.random.default_rng(config.seed)
    drawn = identified.posterior.sample(rng, _DRAWS, config.randomise)
    draws = {}
    for p in identified.parameters:
        if p.kind == "dynamics" and p.name in drawn:
            value, error = p.estimate, config.randomise * number(p.standard_error)
            size = abs(value) or 1e-9
            lacking = np.sqrt(max(0.0, _LEAST_SPREAD**2 - (error / size) ** 2))
            own = drawn[p.name] + lacking * size * rng.standard_normal(_DRAWS)
            low, high = sorted((value / _MOST, value * _MOST))
            draws[p.name] = np.clip(own, low, high)
    return identified.values, draws


def _computation(
    robot: Robot, identified: Identification | None, timing: Timing | None
) -> tuple[dict[str, DelayDistribution], dict[str, int]]:
    """Return how long each node's steps take, and how many were left out of each node as hiccups.

    Raises:
        Sim2RealError: When nothing says how long they take, or most of them are hiccups.
    """
    longest_s = _HICCUP / robot.rate_hz
    computation, dropped = (timing or _timing_of(identified)).computation(longest_s)
    if dropped:
        steps = ", ".join(f"{count} of {name!r}" for name, count in dropped.items())
        note(f"steps longer than {1e3 * longest_s:g} ms are no part of the timing that is trained with: {steps}")
    return computation, dropped


def _timing_of(identified: Identification | None) -> Timing:
    """Return the timing of the recording that was identified from."""
    if identified is None or identified.timing is None:
        raise Sim2RealError(
            "this identification does not say how long the robot's steps take: its timing.json is not beside it",
            hint="name the folder that identify wrote, or run `sim2real identify` again",
        )
    return identified.timing


def draw_timelines(nodes: Mapping[str, BaseNode], supervisor: str, config: TrainConfig) -> tuple[Timeline, int]:
    """Draw timelines without long pauses of the policy.

    Args:
        nodes: The graph.
        supervisor: The node whose steps the policy makes.
        config: How many timelines of which length, and the seed.

    Returns:
        The timelines, and how many were drawn again.

    Raises:
        Sim2RealError: When most timelines have a pause.
    """
    rng = np.random.default_rng(config.seed)
    timeline = draw(nodes, config.episode_s, config.timelines, rng)
    redrawn = 0
    while (bad := _hiccups(timeline, supervisor)).any():
        redrawn += int(bad.sum())
        if redrawn > 20 * config.timelines:
            raise Sim2RealError(
                "nearly every timeline drawn from this log holds a pause of the policy",
                hint="record on a less busy machine, or train shorter episodes with --episode-s",
            )
        again = draw(nodes, config.episode_s, int(bad.sum()), rng)
        timeline = Timeline.stack([timeline[~bad], again]) if (~bad).any() else again
    return timeline, redrawn


def _hiccups(timeline: Timeline, supervisor: str) -> np.ndarray:
    vertex = timeline.vertices[supervisor]
    gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
    return gaps.max(axis=1) > _LONGEST_GAP * np.median(gaps)


def find_parameters(
    pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None
) -> tuple[Path | None, Path | None]:
    """Return the identification to train on, None for the nominal model, and the run folder to write into.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder; None: the newest one with an identification.
    """
    if config.model == "nominal":
        return None, run_dir
    if config.parameters is not None:
        return Path(config.parameters), run_dir
    found = newest(root, pipeline.name, "identify", run_dir)
    return found.output("parameters"), run_dir or found.run_dir


def contract_of(robot: Robot, task: TrainingTask, values: Mapping[str, float]) -> PolicyContract:
    """Return what a policy of a robot sees and does.

    Args:
        robot: The robot.
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
        hashes={},
    )


def _report(bar: Any, p: Progress) -> None:
    bar.set_description_str("train")
    bar.update(1)
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}")


def _history(result: TrainResult) -> History:
    curves = {name: np.asarray(v, np.float64) for name, v in result.history.items()}
    return History(
        steps=np.asarray(result.env_steps, np.float64),
        seconds=np.asarray(result.elapsed_s, np.float64),
        returns=curves.pop("return"),
        success=curves.pop("success"),
        best_seed=result.best_seed,
        compile_s=result.compile_s,
        train_s=result.train_s,
        env_steps_per_s=result.env_steps_per_s,
        others=curves,
    )


def _rows(history: History) -> tuple[list[list[Any]], list[str]]:
    rows = [
        [int(steps), round(float(seconds), 1), float(ret.max()), float(success.max())]
        for steps, seconds, ret, success in zip(
            history.steps, history.seconds, history.returns, history.success, strict=True
        )
    ]
    return rows, ["steps", "seconds", "return", "success"]
