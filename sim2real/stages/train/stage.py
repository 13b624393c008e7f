"""Train a policy on the identified model, with the timing that the robot really has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from sim2real.artifacts.bundle import Bundle, History
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import sha256
from sim2real.artifacts.run.run_folder import OpenStage, StageFolder, open_stage
from sim2real.artifacts.sensitivity import Sensitivity
from sim2real.artifacts.timing import Timing
from sim2real.policy.bundle import make_runner
from sim2real.robots.contract import Robot
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.stages.pipeline import python_arguments
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_parameters import open_identification
from sim2real.stages.pipeline.pipeline import Pipeline, pipeline_of
from sim2real.stages.pipeline.python_arguments import (
    AnyBundle,
    AnyIdentification,
    AnyPath,
    AnyRecording,
    bundle_of,
    config_of,
    identification_of,
    recording_of,
)
from sim2real.stages.terminal.console import note, progress, table
from sim2real.stages.terminal.interruption import patiently
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.explain import disturbance_rows, explain
from sim2real.stages.train.parity import MOST, logged, observations_of, reference_of
from sim2real.stages.train.resume import CHECKPOINT, check_same_parameters, find_interrupted, resumable
from sim2real.stages.train.sensitivity import TIMELINES, models_of, moves_of, sensitivity, with_room
from sim2real.stages.train.teacher_bundle import as_taught, find_teacher, teacher_of
from sim2real.stages.train.tensorboard import event_files
from sim2real.stages.train.training_setup import contract_of, find_parameters, prepare, require_accepted, timing_of
from sim2real.train.config import PPOConfig
from sim2real.train.networks.onnx_export import export_graph
from sim2real.train.networks.policy import Policy
from sim2real.train.ppo.trainer import Progress, TrainResult
from sim2real.train.ppo.trainer import train as learn
from sim2real.train.scale.processes import in_words, join, leads, require_neighbours, wait_for_all
from sim2real.train.sweep import Sweep, named


def train(
    robot: Robot | Pipeline | str,
    identification: AnyIdentification | None = None,
    config: TrainConfig | Mapping[str, Any] | None = None,
    timing: Timing | AnyPath | None = None,
    checkpoint: AnyPath | None = None,
    resume: AnyPath | None = None,
    watch: Callable[[Progress], None] | None = None,
    teacher: AnyBundle | None = None,
    log: AnyRecording | None = None,
) -> Bundle:
    """Train a policy.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: What identify found, or its folder; the nominal model needs none.
        config: How; default: that of the pipeline that loaded the robot. A dict has what is different from it. The
            files that it may name are not read.
        timing: How long everything takes on the robot; default: as in the recording that was identified from. The
            nominal model has no delays.
        checkpoint: File that holds all of the training after each evaluation; None: none is written.
        resume: Such a file, of the same training, to go on from.
        teacher: Whom the policy imitates; None: it learns from rewards.
        log: A recording: on what a policy would have seen there, what will run is compared with what was trained.

    Returns:
        The policy with what it expects and promises; its ``summary`` has numbers about the training.

    Raises:
        UsageError: When the identified model is asked for without an identification, or in another world.
        Sim2RealError: When the identification is of another robot or was not accepted, or its timing cannot be trained
            with.
    """
    if isinstance(identification, TrainConfig):  # the order of earlier versions
        identification, config = cast(Any, config), identification
    pipeline = pipeline_of(robot)
    config = config_of(config, pipeline.train)
    identification = None if identification is None else identification_of(identification)
    timing = None if timing is None else python_arguments.timing_of(timing)
    teacher = None if teacher is None else bundle_of(teacher, "teacher")
    log = None if log is None else recording_of(log, pipeline, "log")
    checkpoint, resume = (None if path is None else Path(path) for path in (checkpoint, resume))
    with progress(None, "train: draw episodes", leads()):
        made = prepare(pipeline, config, identification, timing)
    ppo = replace(config.ppo, eval_steps=made.env.length + 1)
    own = contract_of(made.robot, made.env.task, made.values, made.episodes)
    master = None if teacher is None else teacher_of(teacher, own)
    with progress(ppo.evaluations, "train (compiling)", leads()) as bar, in_words():
        key, sweep = jax.random.key(config.seed), Sweep.parse(config.sweep)
        result = patiently(
            lambda: learn(
                made.env, ppo, key, lambda p: _report(bar, p, watch), checkpoint, resume, sweep, teacher=master
            ),
            require_neighbours,
        )
    weak = None
    if config.sensitivity and leads():
        with progress(None, "train: what breaks the policy"):
            weak = _sensitivity(pipeline, config, identification, timing, made.robot, result.best)
    policy, weights = result.best, result.best.to_weights()
    contract, graph = as_taught(own, policy), export_graph(policy)
    seen = {} if policy.spec.privileged else {"training": result.observations[:MOST]}
    if seen and log is not None and isinstance(made.robot, LoopRobot):
        seen["log"] = observations_of(made.robot, log, make_runner(weights, contract, None, policy.spec, graph))
    references = {name: reference_of(policy, observations) for name, observations in seen.items()}
    about = {"model": config.model} | _told(result, ppo, sweep, made.episodes)
    about |= {} if weak is None else {"what breaks it": weak.advice}
    return Bundle(contract, weights, _history(result), made.episodes, None, weak, policy.spec, graph, references, about)


def _told(result: TrainResult, ppo: PPOConfig, sweep: Sweep, episodes: Episodes) -> dict[str, Any]:
    kept = sweep.names(ppo.num_seeds)[result.best_seed]
    return {
        "success in simulation": f"{result.history['success'].max():.2f} ({kept})",
        "policy steps": int(result.env_steps[-1]) * len(result.members),
        **({} if ppo.target is None else {"target": _target_reached(result, ppo.target)}),
        "policy steps a second": round(result.env_steps_per_s),
        "compile": f"{result.compile_s:.1f} s",
        "train": f"{result.train_s:.1f} s",
        "episodes that end at a pause": f"{episodes.cut} of {episodes.timelines}",
        "timelines drawn again": episodes.again,
        **disturbance_rows(episodes),
    }


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
    env = prepare(pipeline, few, identification, timing, robot=wide).env
    return sensitivity(wide, env, policy, moves, models, config.seed)


def run(pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder | None:
    """Train, and write the policy bundle into a stage folder; of several processes the first one writes.

    Args:
        run_dir: Run folder to add to; None takes the one of the parameters, or a new one for the nominal model.

    Returns:
        The stage; None in a process that writes nothing.
    """
    if config.hosts.several:
        note(str(config.hosts))
    join(config.hosts)  # before anything is computed
    moving_robot(pipeline)  # before anything is read
    interrupted = find_interrupted(pipeline.name, config, root)
    run_dir = run_dir if interrupted is None else interrupted.run_dir
    path, run_dir = find_parameters(pipeline, config, root, run_dir)
    if interrupted is not None:
        check_same_parameters(interrupted, path)
    identification = None if path is None else open_identification(path, pipeline)
    if identification is not None:  # what is refused is refused before a folder is made
        timing_of(identification)
        require_accepted(identification, config)
        if identification.verdict.status != "accepted":
            note(f"trains on an identification that is not accepted: {identification.verdict.status}")
    inputs = {} if path is None else {"parameters": path}
    teacher = None
    if config.distil is not None:
        teacher, inputs["teacher"] = find_teacher(pipeline.name, config.distil, root)
    if config.explain:
        return explain(pipeline, config, identification, inputs, root, run_dir)
    resume = None if interrupted is None else interrupted.folder / CHECKPOINT
    with in_words():
        wait_for_all("all have read what they need")  # what the first one writes now is not taken for that
    if not leads():
        train(pipeline, identification, config, checkpoint=Path(CHECKPOINT), resume=resume)
        return None
    with open_stage(root, pipeline.name, "train", config, inputs, run_dir) as stage:
        with resumable(stage.folder) as checkpoint, _watching(stage, config) as watch:
            kept, log = checkpoint if config.checkpoint else None, logged(identification, stage.run_dir)
            bundle = train(pipeline, identification, config, None, kept, resume, watch, teacher, log)
        hashes = {name: sha256(file) for name, file in inputs.items()}
        if identification is not None and identification.logs:
            hashes["log"] = identification.logs[0].sha256
        bundle = replace(bundle, contract=replace(bundle.contract, hashes=hashes))
        for name, file in bundle.save(stage.folder).items():
            stage.output(name, file)
        if bundle.history is not None:
            print(table(*_rows(bundle.history)))
            if terms := _terms(bundle.history):
                print(table(*terms))
            if bundle.history.settings:
                print(table(*_tried(bundle.history)))
        stage.summary(bundle.summary)
    return stage.result


def _watching(stage: OpenStage, config: TrainConfig) -> AbstractContextManager[Callable[[Progress], None] | None]:
    """Return what is called after each evaluation."""
    if not config.tensorboard:
        return nullcontext()
    names = Sweep.parse(config.sweep).names(config.ppo.num_seeds)
    return event_files(stage.output("tensorboard", "tensorboard"), names)


def _report(bar: Any, p: Progress, watch: Callable[[Progress], None] | None) -> None:
    if watch is not None:
        watch(p)
    bar.set_description_str("train")
    bar.update(1)
    width = f", {p.values['width'].max():.2f} of the differences" if "width" in p.values else ""
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}{width}")


def _terms(history: History) -> tuple[list[list[Any]], list[str]] | None:
    """Return what each named term of the reward added to the return of the kept policy's seed, at each evaluation."""
    if not history.terms:
        return None
    own = history.best_seed or 0
    columns = [history.steps.astype(int), history.returns[:, own], *(c[:, own] for c in history.terms.values())]
    rows = [list(row) for row in zip(*(column.tolist() for column in columns), strict=True)]
    return rows, ["steps", "return", *(f"of it {name}" for name in history.terms)]


def _tried(history: History) -> tuple[list[list[Any]], list[str]]:
    """Return a row for each of the settings that were swept: success over its seeds, and return."""
    rows = []
    for setting in dict.fromkeys(history.settings):
        own = [i for i, name in enumerate(history.settings) if name == setting]
        success, returns = history.success[:, own], history.returns[:, own]
        kept = "*" if history.best_seed in own else ""
        last = success[-1]
        rows.append([setting, *map(float, (last.mean(), last.min(), success.max(), returns[-1].mean())), kept])
    return rows, ["settings", "success", "worst seed", "best so far", "return", "kept"]


def _target_reached(result: TrainResult, target: float) -> str:
    best = result.history["success"][-1].max()
    if best < target:
        return f"{target:g} not reached: {best:.2f} at the end"
    return f"{target:g} reached after {int(result.env_steps[-1]):,} policy steps of each seed"


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
        settings=tuple(map(named, result.members)) if any(result.members) else (),
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
