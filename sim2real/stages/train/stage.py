"""The stage train: a policy on the identified model, with the robot's measured timing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import jax

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run import StageFolder, open_stage
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.load import AnyRobot, defaults_of, moving, robot_of
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import (
    AnyIdentification,
    AnyPath,
    AnyRecording,
    AnyTiming,
    config_of,
    identification_of,
    recordings_of,
)
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.inputs import find_inputs, load_recording
from sim2real.stages.train.resume import CHECKPOINT, resumable
from sim2real.stages.train.sensitivity import policy_sensitivity
from sim2real.stages.train.show import Watch, episode_summary, show_episodes, show_history, show_progress
from sim2real.stages.train.tensorboard import watching
from sim2real.stages.train.trained_bundle import bundle_of_training, contract_of
from sim2real.stages.train.training_setup import TrainingSetup, prepare
from sim2real.training.ppo import trainer
from sim2real.training.scale.processes import join, leads, lost_process_errors, wait_for_all
from sim2real.training.sweep import Sweep
from sim2real.types import Json


def train(
    robot: AnyRobot,
    identification: AnyIdentification | None = None,
    config: TrainConfig | Mapping[str, Json] | None = None,
    timing: AnyTiming | None = None,
    checkpoint: AnyPath | None = None,
    resume: AnyPath | None = None,
    watch: Watch | None = None,
    log: AnyRecording | None = None,
) -> Bundle:
    """Train a policy.

    Args:
        robot: The robot, or the name of its pipeline.
        identification: An identification, or its folder; the nominal model needs none.
        config: Settings; default: those of the robot. A dict has the settings that differ from these. The
            function does not read the files that it names.
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        checkpoint: File that receives the whole training after each evaluation; None: none is written.
        resume: A checkpoint of the same training, to continue from.
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
    robot = moving(robot_of(robot))
    config = config_of(config, defaults_of(robot).train)
    identification = None if identification is None else identification_of(identification)
    timing = None if timing is None else arguments.timing_of(timing)
    recording = None if log is None else recordings_of(log, robot, "log")[0]

    # Draw the episodes.
    with progress(None, "train: draw episodes", leads()):
        setup = prepare(robot, config, identification, timing)
    contract = contract_of(setup.robot, setup.env.task, setup.values, setup.episodes)
    port = "" if recording is None else str(recording.episode.metadata.get("port", ""))
    contract = replace(contract, robot=robot.name if robot.folder is not None else "", port=port)

    # Train.
    write, read = (None if path is None else Path(path) for path in (checkpoint, resume))
    result = _learn(setup, config, write, read, watch)

    # Move each parameter, and play the policy.
    weakness = None
    if config.sensitivity and leads():
        with progress(None, "train: sensitivity of the policy"):
            weakness = policy_sensitivity(robot, config, identification, timing, result.best)
    return bundle_of_training(setup, config, contract, result, weakness, recording)


def run(robot: RecordedRobot, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder | None:
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
    inputs = find_inputs(robot, config, root, run_dir)
    identification, resume = inputs.identification, inputs.resume
    if config.explain:
        return _explain(robot, config, identification, inputs.files, root, inputs.run_dir)

    # Wait for all processes: the first one's new folder must not be an input of a slower one.
    with lost_process_errors():
        wait_for_all("all processes have read their inputs")
    if not leads():
        train(robot, identification, config, checkpoint=Path(CHECKPOINT), resume=resume)
        return None

    # Train, write the bundle, and print.
    with open_stage(root, robot.name, "train", config, inputs.files, inputs.run_dir) as stage:
        with resumable(stage.folder) as checkpoint, watching(stage, config) as watch:
            file, log = checkpoint if config.checkpoint else None, load_recording(identification, stage.run_dir)
            bundle = train(robot, identification, config, None, file, resume, watch, log)
        bundle = inputs.with_hashes(bundle)
        for name, saved in bundle.save(stage.folder).items():
            stage.output(name, saved)
        if bundle.history is not None:
            show_history(bundle.history)
        stage.summary(bundle.summary)
    return stage.result


def _learn(
    setup: TrainingSetup,
    config: TrainConfig,
    checkpoint: Path | None,
    resume: Path | None,
    watch: Watch | None,
) -> trainer.TrainResult:
    """Train by PPO, with a progress bar."""
    ppo = replace(config.ppo, eval_steps=setup.env.length + 1)
    key, sweep = jax.random.key(config.seed), Sweep.parse(config.sweep)
    with progress(ppo.evaluations, "train (compiling)", leads()) as bar, lost_process_errors():
        show = lambda evaluation: show_progress(bar, evaluation, watch)  # noqa: E731
        return patiently(lambda: trainer.train(setup.env, ppo, key, show, checkpoint, resume, sweep=sweep))


def _explain(
    robot: RecordedRobot,
    config: TrainConfig,
    identification: Identification | None,
    inputs: Mapping[str, Path],
    root: Path,
    run_dir: Path | None,
) -> StageFolder:
    """Write and print the distributions into a stage folder ``explain``.

    Args:
        identification: None: the nominal model.
        run_dir: Run folder to add to; None: a new one.
    """
    with open_stage(root, robot.name, "explain", config, inputs, run_dir) as stage:
        episodes = prepare(robot, config, identification).episodes
        for name, file in episodes.save(stage.folder).items():
            stage.output(name, file)
        show_episodes(episodes)
        stage.summary(episode_summary(episodes))
    return stage.result
