"""The stage train: a policy on the identified model, with the robot's measured timing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import cast

import jax
import numpy as np

from sim2real.artifacts.bundle import Bundle, History
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.manifest import sha256
from sim2real.artifacts.run.run_folder import OpenStage, StageFolder, open_stage
from sim2real.artifacts.sensitivity import Sensitivity
from sim2real.artifacts.timing import Timing
from sim2real.policy.bundle import make_runner
from sim2real.policy.contract import PolicyContract
from sim2real.robots.contract import Robot
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
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.explain import explain
from sim2real.stages.train.parity import MAX_OBSERVATIONS, load_recording, observations_of, reference_of
from sim2real.stages.train.resume import CHECKPOINT, check_same_parameters, find_interrupted, resumable
from sim2real.stages.train.sensitivity import TIMELINES, models_of, moves_of, sensitivity, with_room
from sim2real.stages.train.show import show_history, show_progress, training_summary
from sim2real.stages.train.teacher_bundle import find_teacher, policy_contract, teacher_policy
from sim2real.stages.train.tensorboard import event_files
from sim2real.stages.train.training_setup import (
    TrainingSetup,
    contract_of,
    find_parameters,
    prepare,
    require_accepted,
    timing_of,
)
from sim2real.train.networks.onnx_export import export_graph
from sim2real.train.networks.policy import Policy
from sim2real.train.ppo.trainer import Progress, TrainResult
from sim2real.train.ppo.trainer import train as learn
from sim2real.train.scale.processes import join, leads, lost_process_errors, require_neighbours, wait_for_all
from sim2real.train.sweep import Sweep, format_point
from sim2real.types import Json


def train(
    robot: Robot | Pipeline | str,
    identification: AnyIdentification | None = None,
    config: TrainConfig | Mapping[str, Json] | None = None,
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
        identification: An identification, or its folder; the nominal model needs none.
        config: Settings; default: those of the robot's pipeline. A dict has the settings that differ from these. The
            function does not read the files that it names.
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        checkpoint: File that receives the whole training after each evaluation; None: none is written.
        resume: A checkpoint of the same training, to continue from.
        teacher: A policy to imitate; None: learn from rewards.
        log: A recording; the bundle's policy is compared with JAX on the observations in it.

    Returns:
        The policy with its contract; ``summary`` has figures of the training.

    Raises:
        UsageError: The configuration names the identified model without an identification, or another world.
        Sim2RealError: The identification is of another robot or was not accepted, or its timing is unusable.
    """
    # Turn names, folders and dicts into objects.
    if isinstance(identification, TrainConfig):  # the order of earlier versions
        identification, config = cast("AnyIdentification | None", config), identification
    pipeline = pipeline_of(robot)
    config = config_of(config, pipeline.train)
    identification = None if identification is None else identification_of(identification)
    timing = None if timing is None else python_arguments.timing_of(timing)
    teacher = None if teacher is None else bundle_of(teacher, "teacher")
    recording = None if log is None else recording_of(log, pipeline, "log")

    # Draw the episodes.
    with progress(None, "train: draw episodes", leads()):
        setup = prepare(pipeline, config, identification, timing)
    contract = contract_of(setup.robot, setup.env.task, setup.values, setup.episodes)

    # Train.
    master = None if teacher is None else teacher_policy(teacher, contract)
    files = [None if path is None else Path(path) for path in (checkpoint, resume)]
    result = _learn(setup, config, files, watch, master)

    # Move each parameter, and play the policy.
    weakness = None
    if config.sensitivity and leads():
        with progress(None, "train: sensitivity of the policy"):
            weakness = _sensitivity(pipeline, config, identification, timing, setup.robot, result.best)
    return _bundle(setup, config, contract, result, weakness, recording)


def _learn(
    setup: TrainingSetup,
    config: TrainConfig,
    files: Sequence[Path | None],
    watch: Callable[[Progress], None] | None,
    teacher: Policy | None,
) -> TrainResult:
    """Train by PPO, with a progress bar; ``files``: the checkpoint to write, and the one to continue from."""
    ppo = replace(config.ppo, eval_steps=setup.env.length + 1)
    key, sweep = jax.random.key(config.seed), Sweep.parse(config.sweep)
    with progress(ppo.evaluations, "train (compiling)", leads()) as bar, lost_process_errors():
        return patiently(
            lambda: learn(
                setup.env, ppo, key, lambda p: show_progress(bar, p, watch), *files, sweep=sweep, teacher=teacher
            ),
            require_neighbours,
        )


def _bundle(
    setup: TrainingSetup,
    config: TrainConfig,
    contract: PolicyContract,
    result: TrainResult,
    weakness: Sensitivity | None,
    recording: Recording | None,
) -> Bundle:
    """Return the best policy as a bundle, with JAX's actions on observations of training and log to compare with."""
    policy, weights = result.best, result.best.to_weights()
    contract, graph = policy_contract(contract, policy), export_graph(policy)

    # Observations: the last ones of the training, and those of a robot's recording. A teacher runs on no robot.
    observations = {} if policy.spec.privileged else {"training": result.observations[:MAX_OBSERVATIONS]}
    if observations and recording is not None:
        runner = make_runner(weights, contract, None, policy.spec, graph)
        observations["log"] = observations_of(setup.robot, recording, runner)
    references = {name: reference_of(policy, array) for name, array in observations.items()}

    summary = {"model": config.model}
    summary |= training_summary(result, config.ppo, Sweep.parse(config.sweep), setup.episodes)
    summary |= {} if weakness is None else {"what breaks it": weakness.advice}
    return Bundle(
        contract=contract,
        weights=weights,
        history=_history(result),
        episodes=setup.episodes,
        path=None,
        sensitivity=weakness,
        spec=policy.spec,
        graph=graph,
        references=references,
        summary=summary,
    )


def _sensitivity(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None,
    timing: Timing | None,
    robot: Robot,
    policy: Policy,
) -> Sensitivity | None:
    """Return the success of the policy with each parameter moved; None without intervals of the parameters."""
    if config.model == "nominal" or identification is None:
        return None
    moves = moves_of(identification)
    models = models_of(identification.values, moves)
    wide = with_room(robot, models)
    env = prepare(pipeline, replace(config, timelines=TIMELINES), identification, timing, robot=wide).env
    return sensitivity(wide, env, policy, moves, models, config.seed)


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
        settings=tuple(map(format_point, result.members)) if any(result.members) else (),
        others=curves,
    )


def run(pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder | None:
    """Train, and write the policy bundle into a stage folder; of several processes the first one writes.

    Args:
        run_dir: Run folder to add to; None: that of the parameters, or a new one for the nominal model.

    Returns:
        The stage; None in a process that writes nothing.
    """
    # Join the other processes, before JAX computes anything.
    if config.hosts.several:
        note(str(config.hosts))
    join(config.hosts)

    # Find and check the inputs, before a folder is made.
    moving_robot(pipeline)
    interrupted = find_interrupted(pipeline.name, config, root)
    run_dir = run_dir if interrupted is None else interrupted.run_dir
    path, run_dir = find_parameters(pipeline, config, root, run_dir)
    if interrupted is not None:
        check_same_parameters(interrupted, path)
    identification = _open_identification(pipeline, config, path)
    inputs = {} if path is None else {"parameters": path}
    teacher = None
    if config.distil is not None:
        teacher, inputs["teacher"] = find_teacher(pipeline.name, config.distil, root)
    if config.explain:
        return explain(pipeline, config, identification, inputs, root, run_dir)

    # Wait for all processes: the first one's new folder must not be an input of a slower one.
    resume = None if interrupted is None else interrupted.folder / CHECKPOINT
    with lost_process_errors():
        wait_for_all("all processes have read their inputs")
    if not leads():
        train(pipeline, identification, config, checkpoint=Path(CHECKPOINT), resume=resume)
        return None

    # Train, write the bundle, and print.
    with open_stage(root, pipeline.name, "train", config, inputs, run_dir) as stage:
        with resumable(stage.folder) as checkpoint, _watching(stage, config) as watch:
            file, log = checkpoint if config.checkpoint else None, load_recording(identification, stage.run_dir)
            bundle = train(pipeline, identification, config, None, file, resume, watch, teacher, log)
        bundle = _with_hashes(bundle, inputs, identification)
        for name, saved in bundle.save(stage.folder).items():
            stage.output(name, saved)
        if bundle.history is not None:
            show_history(bundle.history)
        stage.summary(bundle.summary)
    return stage.result


def _open_identification(pipeline: Pipeline, config: TrainConfig, path: Path | None) -> Identification | None:
    """Return the identification at a path, checked for training; None for the nominal model."""
    if path is None:
        return None
    identification = open_identification(path, pipeline)
    timing_of(identification)
    require_accepted(identification, config)
    if identification.verdict.status != "accepted":
        note(f"trains on an identification that is not accepted: {identification.verdict.status}")
    return identification


def _with_hashes(bundle: Bundle, inputs: Mapping[str, Path], identification: Identification | None) -> Bundle:
    """Return a bundle whose contract has the hashes of its input files."""
    hashes = {name: sha256(file) for name, file in inputs.items()}
    if identification is not None and identification.logs:
        hashes["log"] = identification.logs[0].sha256
    return replace(bundle, contract=replace(bundle.contract, hashes=hashes))


def _watching(stage: OpenStage, config: TrainConfig) -> AbstractContextManager[Callable[[Progress], None] | None]:
    """Yield the function that receives each evaluation: the writer of TensorBoard's files, or None."""
    if not config.tensorboard:
        return nullcontext()
    names = Sweep.parse(config.sweep).names(config.ppo.num_seeds)
    return event_files(stage.output("tensorboard", "tensorboard"), names)
