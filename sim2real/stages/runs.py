"""Run folders: ``runs/<pipeline>/<time>/{record,identify,train,deploy}/``, each with a manifest.

A stage that is run again in the same run folder gets ``<stage>.2``, ``<stage>.3``, ...: a folder is made once, by the
process that writes into it, and never renamed. So two processes cannot meet in one, nothing recorded is overwritten,
what refers to a file in one goes on being right, and a failed attempt does not hide a finished one.
"""

from __future__ import annotations

import difflib
import errno
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sim2real.errors import ERROR, OK, Sim2RealError, UsageError
from sim2real.stages.manifest import git_state, plain, read_manifest, reserve, sha256, versions, write_manifest
from sim2real.stages.pipeline import available

STAGES = ("record", "identify", "train", "deploy")
DRY = "dry run"
"""Status of a stage that came to its end without moving anything: no later one takes it for a finished one."""
INTERRUPTED = 130
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NAME = re.compile(r"\w[\w.-]*")


@dataclass(frozen=True)
class StageFolder:
    """A stage's folder and what its manifest says."""

    folder: Path
    manifest: Mapping[str, Any]

    @property
    def run_dir(self) -> Path:
        """The run folder it lies in."""
        return self.folder.parent

    @property
    def stage(self) -> str:
        """The stage's name."""
        return self.manifest["stage"]

    @property
    def finished(self) -> bool:
        """Whether the stage came to its end."""
        return self.manifest.get("status") == "finished"

    @property
    def dry(self) -> bool:
        """Whether it moved nothing: what it holds as commands was never sent."""
        return self.manifest.get("dry_run") is True

    @property
    def outputs(self) -> dict[str, Path]:
        """Name -> path of what the stage wrote."""
        return {name: self.folder / entry["path"] for name, entry in self.manifest.get("outputs", {}).items()}

    def output(self, name: str) -> Path:
        """Return the path of one output.

        Raises:
            Sim2RealError: When the stage wrote none of this name, or it has been deleted.
        """
        paths = self.outputs
        if name not in paths:
            raise Sim2RealError(
                f"{self.folder} has no output {name!r}. Available: {', '.join(sorted(paths)) or 'none'}"
            )
        if not paths[name].exists():
            raise Sim2RealError(
                f"{paths[name]} is missing, though the manifest lists it", hint=f"run the stage {self.stage!r} again"
            )
        return paths[name]


@dataclass
class OpenStage:
    """A stage that is running: it writes into ``folder`` and says what it wrote."""

    folder: Path
    _outputs: dict[str, Path] = field(default_factory=dict)
    _summary: dict[str, Any] = field(default_factory=dict)
    _result: StageFolder | None = None

    @property
    def run_dir(self) -> Path:
        """The run folder it lies in."""
        return self.folder.parent

    def output(self, name: str, path: Path | str) -> Path:
        """Name a file or folder that the stage writes, before or after writing it; it is hashed when the stage ends.

        Args:
            name: What later stages ask for.
            path: Inside of the stage's folder; relative paths are relative to it.

        Returns:
            The absolute path.
        """
        full = self.folder / path
        if not full.resolve().is_relative_to(self.folder.resolve()):
            raise UsageError(f"output {name!r} must lie in {self.folder}, got {path}")
        self._outputs[name] = full
        return full

    def summary(self, values: Mapping[str, Any]) -> None:
        """Add the numbers that belong in the table at the end and in the manifest; call it as often as needed."""
        self._summary.update(plain(values))

    @property
    def result(self) -> StageFolder:
        """The finished stage: what a stage function returns; available after the ``with`` block."""
        if self._result is None:
            raise RuntimeError("the stage is still running: ask for its result after the `with` block")
        return self._result


@contextmanager
def open_stage(
    root: Path,
    pipeline: str,
    stage: str,
    config: Any,
    inputs: Mapping[str, Path] | None = None,
    run_dir: Path | None = None,
    dry_run: bool = False,
) -> Iterator[OpenStage]:
    """Run a stage in a folder of its own, with a manifest from the first moment to the last.

    Args:
        root: Folder of all runs.
        pipeline: Name of the pipeline.
        stage: One of ``STAGES``.
        config: The resolved configuration, a dataclass.
        inputs: Name -> file or folder that the stage reads; hashed before it starts.
        run_dir: Run folder to add to; None makes a new one.
        dry_run: Whether the stage only does as if.

    Yields:
        The running stage; at its end the manifest says 'finished', 'dry run', 'failed' or 'interrupted', and the exit
        code.

    Raises:
        UsageError: When there is no such stage, or the pipeline's name is none for a folder.
        Sim2RealError: When an input, or an output after the block, does not exist, or the disk is full.
    """
    _check_names(pipeline, stage)
    hashes = {name: sha256(Path(path)) for name, path in (inputs or {}).items()}
    folder = _stage_folder(run_dir or new_run(root, pipeline), stage)
    hashed = {n: {"path": portable(Path(p), folder.parent), "sha256": hashes[n]} for n, p in (inputs or {}).items()}
    running = OpenStage(folder)
    manifest: dict[str, Any] = {
        "format": 1,
        "pipeline": pipeline,
        "stage": stage,
        "status": "running",
        "dry_run": dry_run,
        "exit_code": None,
        "started": datetime.now(UTC).isoformat(timespec="microseconds"),
        "duration_s": None,
        "command": sys.argv,
        "config": config,
        "inputs": hashed,
        "outputs": {},
        "summary": {},
        "versions": versions(),
        "git": git_state(),
    }
    start = time.monotonic()
    try:
        write_manifest(folder, manifest)
        reserve(folder)
        yield running
        _close(running, manifest, start, DRY if dry_run else "finished", OK)
    except BaseException as error:
        told = _in_words(error, folder)
        try:
            _close(running, manifest, start, *_failure(told), told)
        except OSError as other:
            told.add_note(f"then: the manifest could not be written: {other}")
        if told is error:
            raise
        raise told from error


def _check_names(pipeline: str, stage: str) -> None:
    """Refuse what is no stage, and a pipeline's name that may lead out of the folder of runs: files hold such names."""
    if stage not in STAGES:
        raise UsageError(f"unknown stage {stage!r}. Available: {', '.join(STAGES)}")
    if not _NAME.fullmatch(pipeline):
        raise UsageError(
            f"{pipeline!r} is no name for a pipeline", hint="letters, digits, '_', '-' and '.'; a letter or digit first"
        )


def portable(path: Path, run_dir: Path) -> str:
    """Return a path as an artifact of a run refers to it: relative to the run folder where it lies inside.

    A run that is moved, or copied to another machine, still finds what it refers to; `resolved` is the way back.
    """
    full, home = path.resolve(), run_dir.resolve()
    return full.relative_to(home).as_posix() if full.is_relative_to(home) else str(full)


def resolved(path: str, run_dir: Path) -> Path:
    """Return the path that an artifact of a run refers to."""
    return run_dir / path


def new_run(root: Path, pipeline: str) -> Path:
    """Make a run folder named by the time (UTC, to the millisecond): the names are unique and sort by age."""
    while True:
        now = datetime.now(UTC)
        folder = Path(root) / pipeline / f"{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            time.sleep(0.001)  # two runs started in the same millisecond
        except OSError as error:
            raise _not_writable(folder, error) from error
        else:
            return folder


def attempts(run_dir: Path, stage: str) -> list[StageFolder]:
    """Return all attempts at a stage in a run folder, the latest first."""
    folders = [run_dir / stage, *(f for f in run_dir.glob(f"{stage}.*") if f.suffix[1:].isdigit())]
    found = [(folder, read_manifest(folder)) for folder in folders]
    there = [StageFolder(folder, manifest) for folder, manifest in found if manifest is not None]
    return sorted(there, key=lambda a: (str(a.manifest.get("started", "")), a.folder.name), reverse=True)


def finished(run_dir: Path, stage: str) -> StageFolder | None:
    """Return the latest finished attempt at a stage in a run folder, or None."""
    return next((attempt for attempt in attempts(run_dir, stage) if attempt.finished), None)


def run_folders(root: Path, pipeline: str) -> list[Path]:
    """Return a pipeline's run folders, the oldest first."""
    return sorted(f for f in (Path(root) / pipeline).glob("*") if any(attempts(f, stage) for stage in STAGES))


def newest(root: Path, pipeline: str, stage: str, run_dir: Path | None = None) -> StageFolder:
    """Return the newest finished artifact of a stage.

    Args:
        root: Folder of all runs.
        pipeline: Name of the pipeline.
        stage: The stage whose artifact is wanted.
        run_dir: Run folder that is asked first; without the artifact there, the newest of all runs is taken.

    Raises:
        Sim2RealError: When there is none; the message says what was looked for and the hint which command makes it.
    """
    own = finished(run_dir, stage) if run_dir else None
    if own is not None:
        return own
    candidates = [done for folder in run_folders(root, pipeline) if (done := finished(folder, stage)) is not None]
    if not candidates:
        others = [attempt for folder in run_folders(root, pipeline) for attempt in attempts(folder, stage)]
        dry = sum(attempt.dry for attempt in others)
        kinds = [(len(others) - dry, "unfinished"), (dry, "dry run" if dry == 1 else "dry runs")]
        also = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
        also = f" ({also})" if also else ""
        raise Sim2RealError(
            f"no finished {stage!r} of pipeline {pipeline!r} in {root}{also}",
            hint=f"make one with `sim2real {stage} {pipeline}`, or name another folder with --runs DIR",
        )
    return max(candidates, key=lambda c: c.manifest["started"])


def find_run(root: Path, target: str | Path, pipeline: str | None = None) -> Path:
    """Return a run folder by its path, by its name, by a stage folder in it, or the newest one of a pipeline.

    Of a pipeline's runs the newest in which a stage is finished counts, if there is any: one that failed at its start
    does not hide those before it.

    Args:
        root: Folder of all runs.
        target: What the user typed.
        pipeline: The pipeline that the run has to belong to; None allows any.

    Raises:
        UsageError: When there is no such run, or it belongs to another pipeline.
    """
    path = Path(target)
    # What is above counts for a stage folder only: above a pipeline's name is wherever the user happens to be.
    options = [path.parent if read_manifest(path) is not None else path]
    options += [Path(root) / pipeline / path] if pipeline else sorted(Path(root).glob(f"*/{path.name}"))
    for folder in options:
        owners = {str(a.manifest.get("pipeline")) for stage in STAGES for a in attempts(folder, stage)}
        if owners and pipeline and pipeline not in owners:
            raise UsageError(f"{folder} is a run of {', '.join(sorted(owners))}, not of {pipeline}")
        if owners:
            return folder
    if pipeline is None and (known := run_folders(root, str(target))):
        return next((f for f in reversed(known) if any(finished(f, stage) for stage in STAGES)), known[-1])
    raise _nothing_there(root, str(target))


def _stage_folder(run_dir: Path, stage: str) -> Path:
    """Make a stage's folder, under the first free number; making it takes it, whoever else is at work here."""
    number = 1
    while True:
        folder = run_dir / (stage if number == 1 else f"{stage}.{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
        except OSError as error:
            raise _not_writable(folder, error) from error
        else:
            return folder


def _nothing_there(root: Path, target: str) -> UsageError:
    """Return the error for a name that is none: it says what there is."""
    pipelines = sorted(available())
    names = [f"{f.parent.name}/{f.name}" for p in sorted(Path(root).glob("*")) for f in run_folders(root, p.name)]
    said = f"Pipelines: {', '.join(pipelines) or 'none'}. Runs in {root}: {', '.join(names[-5:]) or 'none'}"
    if target in pipelines:
        hint = f"make a run with `sim2real run {target}`, or name another folder with --runs DIR"
    elif close := difflib.get_close_matches(target, [*pipelines, *(n.partition("/")[2] for n in names)], n=1):
        hint = f"did you mean {close[0]}?"
    else:
        hint = "make a run with `sim2real run PIPELINE`, or name another folder with --runs DIR"
    return UsageError(f"there is no file, pipeline or run {target!r}. {said}", hint=hint)


def _not_writable(folder: Path, error: OSError) -> Sim2RealError:
    return Sim2RealError(
        f"cannot write the run folder {folder}: {error.strerror}", hint="name a folder of your own with --runs DIR"
    )


def _in_words(error: BaseException, folder: Path) -> BaseException:
    """Return what the user is told of an exception: the cause, where a full disk is behind it."""
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return error
    where = f" (writing {os.fsdecode(error.filename)})" if isinstance(error.filename, str | bytes) else ""
    return Sim2RealError(
        f"the disk is full: {error.strerror}{where}",
        hint=f"free some space, or name a folder elsewhere with --runs DIR; what was written is in {folder}",
    )


def _failure(error: BaseException) -> tuple[str, int]:
    """Return the status and the exit code that an exception ends a stage with."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPTED
    if isinstance(error, SystemExit | GeneratorExit):
        code = error.code if isinstance(error, SystemExit) else None
        return "interrupted", code if isinstance(code, int) else ERROR
    return "failed", error.exit_code if isinstance(error, Sim2RealError) else ERROR


def _close(
    stage: OpenStage,
    manifest: dict[str, Any],
    start: float,
    status: str,
    code: int,
    error: BaseException | None = None,
) -> None:
    """Write the last manifest; a stage that failed lists only the outputs that exist."""
    paths = stage._outputs if error is None else {n: p for n, p in stage._outputs.items() if p.exists()}
    manifest["outputs"] = {
        name: {"path": path.relative_to(stage.folder).as_posix(), "sha256": sha256(path)}
        for name, path in paths.items()
    }
    manifest |= {"status": status, "exit_code": code, "summary": stage._summary}
    manifest["duration_s"] = round(time.monotonic() - start, 3)
    if error is not None:
        manifest["error"] = "\n".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
    write_manifest(stage.folder, manifest)
    stage._result = StageFolder(stage.folder, read_manifest(stage.folder) or manifest)
