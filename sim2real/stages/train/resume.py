"""Continuing a training that was interrupted."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim2real.artifacts.run import RUNNING, StageFolder, attempts, run_folders, sha256
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.shared.find_run import find_run
from sim2real.stages.terminal.console import note, shown
from sim2real.stages.train.config import TrainConfig

CHECKPOINT = "checkpoint.safetensors"
NEWEST = "newest"


def find_interrupted(pipeline: str, config: TrainConfig, root: Path) -> StageFolder | None:
    """Return the interrupted training that ``config.resume`` names; None without ``config.resume``."""
    if config.resume is None:
        return None
    interrupted = _newest_unfinished(pipeline, config.resume, root)
    if interrupted is None:
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


def check_same_parameters(interrupted: StageFolder, path: Path | None) -> None:
    """Raise a ``UsageError`` if the parameters at ``path`` differ from those of the interrupted training."""
    before = interrupted.manifest.inputs.get("parameters")
    if (before and before.sha256) != (None if path is None else sha256(path)):
        raise UsageError(
            f"{interrupted.folder} trains on other parameters than {path or 'the nominal ones'}",
            hint="give the parameters of the interrupted training by --parameters, or drop --resume",
        )


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
    file.unlink(missing_ok=True)  # a finished training needs none


def _newest_unfinished(pipeline: str, target: str, root: Path) -> StageFolder | None:
    """Return the newest unfinished training in a run, in a pipeline's runs, or the one of a stage's folder."""
    # List the trainings at the target.
    named = StageFolder.read(Path(target))
    if named is not None and named.stage == "train":
        trainings = [named]
        if named.manifest.pipeline != pipeline:
            raise UsageError(f"{target} is a training of {named.manifest.pipeline}, not of {pipeline}")
    else:
        runs = run_folders(root, pipeline) if target == NEWEST else [find_run(root, target, pipeline)]
        trainings = [attempt for run in runs for attempt in attempts(run, "train")]

    # Drop finished ones, and those that still run.
    unfinished = [attempt for attempt in trainings if not attempt.finished]
    busy = [a.folder for a in unfinished if a.manifest.status == RUNNING]
    if busy and len(busy) == len(unfinished):
        raise UsageError(
            f"the training in {busy[0]} is still running: two processes would write the same policy",
            hint="wait until it has ended, or end it by Ctrl-C, and resume it then",
        )
    unfinished = [attempt for attempt in unfinished if attempt.folder not in busy]
    return max(unfinished, key=lambda a: a.manifest.started, default=None)
