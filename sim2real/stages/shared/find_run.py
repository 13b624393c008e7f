"""Finds a run, an identification or a policy by path, by name, or as the newest of a pipeline."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.run import (
    STAGES,
    StageFolder,
    attempts,
    finished,
    newest,
    pipeline_of,
    run_folders,
    stage_status,
    why_stale,
)
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.load import available, folder_of, shipped_policy
from sim2real.stages.terminal.console import note

if TYPE_CHECKING:
    from sim2real.robots.robot import RecordedRobot


def find_run(root: Path, target: str | Path, pipeline: str | None = None) -> Path:
    """Return a run folder by its path, by its name, by a stage folder in it, or the newest one of a pipeline.

    Of a pipeline's runs, the newest with a finished stage is taken.

    Args:
        pipeline: The pipeline to which the run must belong; None: any.
    """
    path = Path(target)
    # Only a stage folder selects its parent: the parent of a pipeline's name would be the working directory.
    options = [path.parent if StageFolder.read(path) is not None else path]
    options += [Path(root) / pipeline / path] if pipeline else sorted(Path(root).glob(f"*/{path.name}"))
    for folder in options:
        owners = {a.manifest.pipeline for stage in STAGES for a in attempts(folder, stage)}
        if owners and pipeline and pipeline not in owners:
            raise UsageError(f"{folder} is a run of {', '.join(sorted(owners))}, not of {pipeline}")
        if owners:
            return folder
    if pipeline is None and (folders := run_folders(root, str(target))):
        return next((f for f in reversed(folders) if any(finished(f, stage) for stage in STAGES)), folders[-1])
    raise _nothing_there(root, str(target))


def find_parameters(source: str, runs: Path, run_dir: Path | None = None) -> Path:
    """Return the file of the identification that a text names: a file, a stage folder, a pipeline or a run.

    Args:
        run_dir: Run in which a pipeline's identification is looked for; None: any.
    """
    from sim2real.artifacts.identification import PARAMETERS

    path = Path(source)
    if path.is_file():
        return path
    if (path / PARAMETERS).is_file():
        return path / PARAMETERS
    return _output(source, runs, "identify", "parameters", run_dir)


def find_bundle(source: str, runs: Path, run_dir: Path | None = None) -> Path:
    """Return the folder of the policy bundle that a text names: a bundle, a stage folder, a pipeline or a run.

    For a pipeline without a training, its shipped bundle is taken.

    Args:
        run_dir: Run in which a training of the pipeline is searched; None: any.
    """
    from sim2real.artifacts.bundle import BUNDLE
    from sim2real.policy.bundle import CONTRACT

    for folder in (Path(source), Path(source) / BUNDLE):
        if (folder / CONTRACT).is_file():
            return folder
    if Path(source).is_file():
        raise UsageError(
            f"{source} is a file, where the folder of a policy bundle is expected: policy.json says what the network's "
            "inputs and outputs mean, which a network alone does not",
            hint="a policy of another library becomes a bundle with sim2real.policy.bundle.save_bundle",
        )
    try:
        return _output(source, runs, "train", "bundle", run_dir)
    except Sim2RealError:
        if source in available() and (shipped := shipped_policy(folder_of(source))) is not None:
            return shipped
        raise


def _output(source: str, runs: Path, stage: str, name: str, run_dir: Path | None) -> Path:
    """Return an output of a stage: the newest of a pipeline, or of a run."""
    known = source in available()
    run_dir = run_dir if known else find_run(runs, source)
    pipeline = source if known or run_dir is None else pipeline_of(run_dir)
    return warn_of_stale(newest(runs, pipeline, stage, run_dir)).output(name)


def newest_recording(robot: RecordedRobot, root: Path, run_dir: Path | None = None) -> StageFolder:
    """Return the newest finished recording of a robot, preferably in the given run.

    Raises:
        UsageError: There is none, and the robot has no motors to make one.
        Sim2RealError: There is none.
    """
    try:
        return newest(root, robot.name, "record", run_dir)
    except Sim2RealError as error:
        from sim2real.robots.robot import Robot  # JAX takes 0.5 s

        if isinstance(robot, Robot):
            raise
        raise UsageError(
            f"there is no recording of {robot.name!r} in {root}, and the pipeline has no motors to make one",
            hint=f"name a log with --log FILE, or `sim2real import FILE --pipeline {robot.name}`",
        ) from error


def warn_of_stale(folder: StageFolder) -> StageFolder:
    """Return a finished stage; print a warning if its run has a newer input of the stage."""
    if why := why_stale(folder, stage_status(folder.run_dir)):
        note(f"warning: {why}; `sim2real run {folder.manifest.pipeline} --resume {folder.run_dir}` makes it again")
    return folder


def _nothing_there(root: Path, target: str) -> UsageError:
    """Return the error for an unknown name, with the available names."""
    pipelines = sorted(available())
    names = [f"{f.parent.name}/{f.name}" for p in sorted(Path(root).glob("*")) for f in run_folders(root, p.name)]
    listed = f"Pipelines: {', '.join(pipelines) or 'none'}. Runs in {root}: {', '.join(names[-5:]) or 'none'}"
    if Path(target).exists():
        what = "a file" if Path(target).is_file() else "a folder without a stage of a run"
        return UsageError(
            f"{target} is {what}, where a run, a folder of a stage, or a pipeline is expected. {listed}",
            hint="name the folder of the run",
        )
    if target in pipelines:
        hint = f"make a run with `sim2real run {target}`, or name another folder with --runs DIR"
        return UsageError(f"pipeline {target!r} has no run in {root}", hint=hint)
    if close := difflib.get_close_matches(target, [*pipelines, *(n.partition("/")[2] for n in names)], n=1):
        hint = f"did you mean {close[0]}?"
    elif Path(target).suffix or Path(target).name != target:
        hint = "check the path"
    else:
        hint = "make a run with `sim2real run PIPELINE`, or name another folder with --runs DIR"
    return UsageError(f"there is no file, pipeline or run {target!r}. {listed}", hint=hint)
