"""Going on with a training that was interrupted."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sim2real.artifacts.run.manifest import RUNNING, plain, read_manifest, sha256
from sim2real.artifacts.run.run_folder import StageFolder, attempts, run_folders
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.pipeline.find_run import find_run
from sim2real.stages.terminal.console import note, shown
from sim2real.stages.train.config import TrainConfig

CHECKPOINT = "checkpoint.safetensors"
NEWEST = "newest"
_HOSTS = ("hosts.found", "hosts.coordinator", "hosts.processes", "hosts.process", "hosts.timeout_s")
_MAY_DIFFER = ("resume", "parameters", "ppo.target", "tensorboard", "checkpoint", *_HOSTS)
"""Settings that do not change how training goes; which parameters they are is told by their digest, and how many
devices share it by the program."""


def find_interrupted(pipeline: str, config: TrainConfig, root: Path) -> StageFolder | None:
    """Return the interrupted training that ``config.resume`` names, None where it names none.

    Args:
        config: The settings of the training that goes on.

    Raises:
        UsageError: There is none, or it had other settings.
        Sim2RealError: It was interrupted before its first evaluation.
    """
    if config.resume is None:
        return None
    found = _named(pipeline, config.resume, root)
    if found is None:
        raise UsageError(
            f"there is no interrupted training of {pipeline!r} in {config.resume if config.resume != NEWEST else root}",
            hint=f"name the run folder or the folder of the training, or train anew with `sim2real train {pipeline}`",
        )
    _refuse_other_settings(found, config)
    if not (found.folder / CHECKPOINT).is_file():
        raise Sim2RealError(
            f"{found.folder} was interrupted before its first evaluation: there is nothing to go on with",
            hint=f"train anew with `sim2real train {pipeline}`; --ppo.evaluations says how often it is saved",
        )
    return found


def check_same_parameters(interrupted: StageFolder, path: Path | None) -> None:
    """Compare the parameters to train on with those of the interrupted training.

    Raises:
        UsageError: They are others.
    """
    before = interrupted.manifest.get("inputs", {}).get("parameters", {}).get("sha256")
    if before != (None if path is None else sha256(path)):
        raise UsageError(
            f"{interrupted.folder} trains on other parameters than {path or 'the nominal ones'}",
            hint="name the ones that it began with by --parameters, or train anew",
        )


@contextmanager
def resumable(folder: Path) -> Iterator[Path]:
    """Yield the checkpoint's file in a stage's folder; say how to go on where training is interrupted."""
    file = folder / CHECKPOINT
    try:
        yield file
    except (KeyboardInterrupt, SystemExit):
        if file.is_file():
            note(f"the same command with `--resume {shown(folder)}` goes on from the last evaluation")
        raise
    file.unlink(missing_ok=True)  # a finished training needs none


def _named(pipeline: str, target: str, root: Path) -> StageFolder | None:
    """Return the newest unfinished training in a run, in a pipeline's runs, or the one of a stage's folder."""
    manifest = read_manifest(Path(target))
    if manifest is not None and manifest["stage"] == "train":
        own = [StageFolder(Path(target), manifest)]
        if manifest["pipeline"] != pipeline:
            raise UsageError(f"{target} is a training of {manifest['pipeline']}, not of {pipeline}")
    else:
        runs = run_folders(root, pipeline) if target == NEWEST else [find_run(root, target, pipeline)]
        own = [attempt for run in runs for attempt in attempts(run, "train")]
    unfinished = [attempt for attempt in own if not attempt.finished]
    busy = [a.folder for a in unfinished if a.manifest["status"] == RUNNING]
    if busy and len(busy) == len(unfinished):
        raise UsageError(
            f"the training in {busy[0]} is still running: two processes would write the same policy",
            hint="wait until it has ended, or end it by Ctrl-C, and resume it then",
        )
    unfinished = [attempt for attempt in unfinished if attempt.folder not in busy]
    return max(unfinished, key=lambda a: str(a.manifest.get("started", "")), default=None)


def _refuse_other_settings(found: StageFolder, config: TrainConfig) -> None:
    there, here = _flat(found.manifest.get("config") or {}), _flat(plain(config))
    names = [n for n in {**there, **here} if there.get(n) != here.get(n) and n not in _MAY_DIFFER]
    if names:
        said = ", ".join(f"{n} = {there.get(n)} there and {here.get(n)} here" for n in names)
        command = shlex.join(["sim2real", *map(str, found.manifest.get("command", [])[1:])])
        raise UsageError(
            f"{found.folder} is a training with other settings: {said}",
            hint=f"go on with those it began with, it was: {command}",
        )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dots in their names."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat
