"""The stage train: a policy on the identified model, with the robot's measured timing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import RUNNING, StageFolder, attempts, open_stage, run_folders, sha256
from sim2real.errors import Sim2RealError, UsageError
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
from sim2real.stages.shared.find_run import find_parameters, find_run
from sim2real.stages.terminal.console import artifact_table, note, progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.stages.train.bundle import Watch, bundle_of_training, contract_of, disturbance_rows
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.sensitivity import policy_sensitivity
from sim2real.stages.train.setup import TrainingSetup, check_identification, prepare, timing_of
from sim2real.training.ppo import trainer
from sim2real.training.ppo.trainer import Progress
from sim2real.training.scale.processes import join, leads, lost_process_errors, wait_for_all
from sim2real.training.sweep import Sweep
from sim2real.types import Json

CHECKPOINT = "checkpoint.safetensors"
NEWEST = "newest"


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
        config: Settings; default: the robot's. A dict has the settings that differ from these. Files in the settings
            are not read.
        timing: The robot's timing; default: that of the identification's recording. The nominal model has no delays.
        checkpoint: File to which the whole training is written after each evaluation; None: no file.
        resume: A checkpoint of the same training, to continue from.
        watch: Receives the figures of each evaluation.
        log: A recording; the bundle's policy is compared with JAX on the observations in it.

    Returns:
        The policy with its contract; ``summary`` has figures of the training.

    Raises:
        UsageError: The configuration names the identified model without an identification, or another world.
        Sim2RealError: The identification is of another robot or was not accepted, or its timing is unusable.
    """
    # Turn names, folders and dicts into objects.
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

    # Train; then play the policy with each parameter moved.
    write, read = (None if path is None else Path(path) for path in (checkpoint, resume))
    result = _learn(setup, config, write, read, watch)
    weakness = None
    if config.sensitivity and leads():
        with progress(None, "train: sensitivity of the policy"):
            weakness = policy_sensitivity(robot, config, identification, timing, result.best)
    return bundle_of_training(setup, config, contract, result, weakness, recording)


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


def show_progress(bar: Any, p: Progress, watch: Watch | None) -> None:
    """Show an evaluation's figures next to the progress bar, after ``watch`` has received them."""
    if watch is not None:
        watch(p)
    bar.set_description_str("train")
    bar.update(1)
    width = f", {p.values['width'].max():.2f} of the differences" if "width" in p.values else ""
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}{width}")


def run(robot: RecordedRobot, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder | None:
    """Train, and write the policy bundle into a stage folder; of several processes the first one writes.

    Args:
        run_dir: Run folder to add to; None: the parameters' run, or a new one for the nominal model.

    Returns:
        The stage; None in a process that writes nothing.
    """
    # Join the other processes, before JAX computes anything.
    if config.hosts.several:
        note(str(config.hosts))
    join(config.hosts)

    # Find and check the inputs, before a folder is made.
    moving(robot)
    interrupted = find_interrupted(robot.name, config, root)
    run_dir = run_dir if interrupted is None else interrupted.run_dir
    path = None
    if config.model != "nominal":
        path = find_parameters(config.parameters or robot.name, root, run_dir)
        run_dir = run_dir if config.parameters else run_dir or path.parent.parent
    resume = None
    if interrupted is not None:
        resume = interrupted.folder / CHECKPOINT
    identification = None if path is None else check_identification(robot, config, Identification.load(path))
    if identification is not None:
        timing_of(identification)
        if identification.verdict.status != "accepted":
            note(f"trains on an identification that is not accepted: {identification.verdict.status}")
    files = {} if path is None else {"parameters": path}
    if config.explain:
        return _explain(robot, config, identification, files, root, run_dir)

    # Wait for all processes: the new folder of the first must not become an input of a slower one.
    with lost_process_errors():
        wait_for_all("all processes have read their inputs")
    if not leads():
        train(robot, identification, config, checkpoint=Path(CHECKPOINT), resume=resume)
        return None

    # Train, write the bundle with the hashes of its input files, and print.
    with open_stage(root, robot.name, "train", config, files, run_dir) as stage:
        with resumable(stage.folder) as checkpoint:
            file, log = checkpoint if config.checkpoint else None, _recording(identification, stage.run_dir)
            bundle = train(robot, identification, config, checkpoint=file, resume=resume, log=log)
        hashes = {name: sha256(file) for name, file in files.items()}
        if identification is not None and identification.logs:
            hashes["log"] = identification.logs[0].sha256
        bundle = replace(bundle, contract=replace(bundle.contract, hashes=hashes))
        for name, saved in bundle.save(stage.folder).items():
            stage.output(name, saved)
        if bundle.history is not None:
            print(artifact_table(bundle.history.rows()))
        stage.summary(bundle.summary)
    return stage.result


def _explain(
    robot: RecordedRobot,
    config: TrainConfig,
    identification: Identification | None,
    inputs: Mapping[str, Path],
    root: Path,
    run_dir: Path | None,
) -> StageFolder:
    """Print the distributions, and write them into a stage folder ``explain``."""
    with open_stage(root, robot.name, "explain", config, inputs, run_dir) as stage:
        episodes = prepare(robot, config, identification).episodes
        for name, file in episodes.save(stage.folder).items():
            stage.output(name, file)
        for content in (episodes.rows(), episodes.noise_table()):
            if content.rows:
                print(artifact_table(content))
        stage.summary(
            {
                "posterior": f"deviations times {episodes.widening:.1f}, for the misfit of the model",
                "timelines": episodes.timelines,
                "episodes that end at a pause": episodes.cut,
                "timelines drawn again": episodes.again,
                "longest pause": f"{1e3 * episodes.longest_pause_s:.1f} ms",
                **disturbance_rows(episodes),
            }
        )
    return stage.result


# -- inputs


def _recording(identification: Identification | None, run_dir: Path) -> Recording | None:
    """Return the recording of an identification; None if its file is missing, as training does not need it."""
    if identification is None or not identification.logs:
        return None
    path = run_dir / identification.logs[0].path
    try:
        return Recording.load(path) if path.is_file() else None
    except Sim2RealError as error:
        note(f"warning: the runner is not compared with JAX on the log: {error}")
        return None


# -- a training that was interrupted


@contextmanager
def resumable(folder: Path) -> Iterator[Path]:
    """Yield the checkpoint's file in a stage's folder; print the command to continue if training is interrupted."""
    file = folder / CHECKPOINT
    try:
        yield file
    except (KeyboardInterrupt, SystemExit):
        if file.is_file():
            note(f"the same command with `--resume {shown(folder)}` continues from the last evaluation")
        raise
    file.unlink(missing_ok=True)  # a finished training needs no checkpoint


def find_interrupted(pipeline: str, config: TrainConfig, root: Path) -> StageFolder | None:
    """Return the interrupted training that ``config.resume`` names; None without ``config.resume``."""
    if config.resume is None:
        return None
    # List the trainings in a run or in a pipeline's runs, or take the training of a stage's folder.
    named = StageFolder.read(Path(config.resume))
    if named is not None and named.stage == "train":
        trainings = [named]
        if named.manifest.pipeline != pipeline:
            raise UsageError(f"{config.resume} is a training of {named.manifest.pipeline}, not of {pipeline}")
    else:
        newest_one = config.resume == NEWEST
        runs = run_folders(root, pipeline) if newest_one else [find_run(root, config.resume, pipeline)]
        trainings = [attempt for run in runs for attempt in attempts(run, "train")]

    # Drop trainings that are finished or still running.
    unfinished = [attempt for attempt in trainings if not attempt.finished]
    idle = [attempt for attempt in unfinished if attempt.manifest.status != RUNNING]
    if unfinished and not idle:
        raise UsageError(
            f"the training in {unfinished[0].folder} is still running: two processes would write the same policy",
            hint="wait until it has ended, or end it by Ctrl-C, and resume it then",
        )
    if (interrupted := max(idle, key=lambda a: a.manifest.started, default=None)) is None:
        raise UsageError(
            f"there is no interrupted training of {pipeline!r} in {config.resume if config.resume != NEWEST else root}",
            hint=f"name the run folder or the folder of the training, or start one with `sim2real train {pipeline}`",
        )
    if not (interrupted.folder / CHECKPOINT).is_file():
        raise Sim2RealError(
            f"{interrupted.folder} was interrupted before its first evaluation: it has no checkpoint",
            hint=f"start again with `sim2real train {pipeline}`; --ppo.evaluations sets the number of checkpoints",
        )
    return interrupted
