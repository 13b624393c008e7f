"""Run folders: ``runs/<pipeline>/<time>/{record,identify,train,deploy}/``, each with a manifest.

A repeated stage in the same run folder gets ``<stage>.2``, ``<stage>.3``, ...: the process that writes into a folder
creates it, and the folder is never renamed. So two processes never write into the same folder, files are never
overwritten, references to files stay valid, and a failed attempt does not hide a finished one.
"""

from __future__ import annotations

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

from sim2real.artifacts.files import plain
from sim2real.artifacts.run.manifest import (
    RUNNING,
    git_state,
    read_manifest,
    reserve,
    sha256,
    versions,
    write_manifest,
)
from sim2real.errors import ERROR, OK, Sim2RealError, UsageError
from sim2real.types import Json

STAGES = ("record", "identify", "train", "deploy")
DRY = "dry run"
"""Status of a finished stage that sent no commands: later stages do not use it."""
INTERRUPTED = 130
_NAME = re.compile(r"\w[\w.-]*")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Source:
    """A source file of an artifact: its path, relative to the run folder, and its SHA-256; "" without a file."""

    path: str
    sha256: str

    @staticmethod
    def of(path: Path, run_dir: Path) -> Source:
        """Return the source for a file."""
        return Source(portable(path, run_dir), sha256(path))


@dataclass(frozen=True)
class StageFolder:
    """A stage's folder and its manifest."""

    folder: Path
    manifest: Mapping[str, Json]

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
        """Whether the stage finished."""
        return self.manifest.get("status") == "finished"

    @property
    def dry(self) -> bool:
        """Whether the stage sent no commands."""
        return self.manifest.get("dry_run") is True

    @property
    def outputs(self) -> dict[str, Path]:
        """Name -> path of each output."""
        return {name: self.folder / entry["path"] for name, entry in self.manifest.get("outputs", {}).items()}

    def logs(self) -> list[Path]:
        """Return the logs of a recording; an imported data set has one for each episode."""
        names = [name for name in self.outputs if name == "log" or name.startswith("log_")]
        return [self.output(name) for name in sorted(names, key=lambda name: (len(name), name)) or ["log"]]

    def output(self, name: str) -> Path:
        """Return the path of one output.

        Raises:
            Sim2RealError: When the stage has no such output, or the file was deleted.
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
    """A running stage, which writes into ``folder`` and registers its outputs."""

    folder: Path
    _outputs: dict[str, Path] = field(default_factory=dict)
    _summary: dict[str, Json] = field(default_factory=dict)
    _result: StageFolder | None = None

    @property
    def run_dir(self) -> Path:
        """The run folder it lies in."""
        return self.folder.parent

    def output(self, name: str, path: Path | str) -> Path:
        """Register an output by its path in the stage's folder; return the absolute path. The stage's end hashes it."""
        full = self.folder / path
        if not full.resolve().is_relative_to(self.folder.resolve()):
            raise UsageError(f"output {name!r} must lie in {self.folder}, got {path}")
        self._outputs[name] = full
        return full

    def summary(self, values: Mapping[str, Json]) -> None:
        """Add values to the summary, which the console prints and the manifest holds."""
        self._summary.update(plain(values))

    @property
    def result(self) -> StageFolder:
        """The finished stage, available after the ``with`` block."""
        if self._result is None:
            raise RuntimeError("the stage is still running: read its result after the `with` block")
        return self._result


@contextmanager
def open_stage(
    root: Path,
    pipeline: str,
    stage: str,
    config: object,
    inputs: Mapping[str, Path] | None = None,
    run_dir: Path | None = None,
    dry_run: bool = False,
) -> Iterator[OpenStage]:
    """Run a stage in a new folder, with a manifest from its start to its end.

    Args:
        stage: Name of the stage, which is also the name of its folder.
        config: The resolved configuration, a dataclass.
        inputs: Name -> input file or folder; hashed before the stage starts.
        run_dir: Run folder to add to; None makes a new one.

    Yields:
        The running stage. At its end, the manifest gets the status (finished, dry run, failed, interrupted) and the
        exit code.

    Raises:
        UsageError: When the name of the stage or the pipeline is no valid folder name.
        Sim2RealError: When an input, or an output after the block, does not exist, or the disk is full.
    """
    # Refuse names that are no folder in the folder of runs, as a pipeline's name can come from a file.
    if not stage.isidentifier():
        raise UsageError(f"{stage!r} is no name for a stage", hint="letters, digits and '_'; a letter first")
    if not _NAME.fullmatch(pipeline):
        raise UsageError(
            f"{pipeline!r} is no name for a pipeline", hint="letters, digits, '_', '-' and '.'; a letter or digit first"
        )
    # Hash the inputs first, as the stage can take hours and files can change.
    hashes = {name: sha256(Path(path)) for name, path in (inputs or {}).items()}
    folder = _stage_folder(run_dir or new_run(root, pipeline), stage)
    hashed = {n: {"path": portable(Path(p), folder.parent), "sha256": hashes[n]} for n, p in (inputs or {}).items()}
    # Write the first manifest with a lock, then run the stage and write the last manifest.
    running = OpenStage(folder)
    manifest = _first_manifest(pipeline, stage, config, hashed, dry_run)
    start, lock = time.monotonic(), None
    try:
        lock = write_manifest(folder, manifest, lock=True)
        reserve(folder)
        yield running
        _close(running, manifest, start, DRY if dry_run else "finished", OK)
    except BaseException as error:
        failure = _readable(error, folder)
        try:
            _close(running, manifest, start, *_failure(failure), failure)
        except OSError as other:
            failure.add_note(f"then: the manifest could not be written: {other}")
        if failure is error:
            raise
        raise failure from error
    finally:
        if lock is not None:
            os.close(lock)


def _first_manifest(
    pipeline: str, stage: str, config: object, inputs: Mapping[str, Json], dry_run: bool
) -> dict[str, Json]:
    """Return the manifest of a stage that starts now."""
    return {
        "format": 1,
        "pipeline": pipeline,
        "stage": stage,
        "status": RUNNING,
        "dry_run": dry_run,
        "exit_code": None,
        "started": datetime.now(UTC).isoformat(timespec="microseconds"),
        "duration_s": None,
        "command": sys.argv,
        "config": config,
        "inputs": inputs,
        "outputs": {},
        "summary": {},
        "versions": versions(),
        "git": git_state(),
    }


def portable(path: Path, run_dir: Path) -> str:
    """Return a path relative to the run folder, so that a moved or copied run finds its files."""
    return Path(os.path.relpath(path.resolve(), run_dir.resolve())).as_posix()


def new_run(root: Path, pipeline: str) -> Path:
    """Create a run folder named by the time (UTC, to the millisecond); the names are unique and sort by age."""
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
    """Return all attempts at a stage in a run folder, the latest number first, as clocks can be set back."""
    numbers = [int(f.suffix[1:]) for f in run_dir.glob(f"{stage}.*") if f.suffix[1:].isdecimal()]
    folders = [*(run_dir / f"{stage}.{n}" for n in sorted(numbers, reverse=True)), run_dir / stage]
    manifests = [(folder, read_manifest(folder)) for folder in folders]
    return [StageFolder(folder, manifest) for folder, manifest in manifests if manifest is not None]


def finished(run_dir: Path, stage: str) -> StageFolder | None:
    """Return the latest finished attempt at a stage in a run folder, or None."""
    return next((attempt for attempt in attempts(run_dir, stage) if attempt.finished), None)


def open_folder(folder: Path, stage: str) -> StageFolder:
    """Return a stage's folder, finished or not.

    Raises:
        Sim2RealError: When there is no such folder.
    """
    if not folder.is_dir():
        raise Sim2RealError(f"there is no folder {folder}", hint=f"make one with `sim2real {stage} PIPELINE`")
    return StageFolder(folder, read_manifest(folder) or {"stage": stage})


def finished_stages(run_dir: Path) -> dict[str, StageFolder]:
    """Return stage -> its latest finished attempt, in the order of the stages; a dry run if there is no other.

    Raises:
        Sim2RealError: When no stage is finished.
    """
    latest = {}
    for stage in STAGES:
        all_attempts = attempts(run_dir, stage)
        done = [a for a in all_attempts if a.finished] + [a for a in all_attempts if a.manifest.get("status") == DRY]
        if done:
            latest[stage] = done[0]
    if not latest:
        raise Sim2RealError(
            f"{run_dir} has no finished stage. Looked for: {', '.join(STAGES)}",
            hint="make one with `sim2real record PIPELINE`, or name another run",
        )
    return latest


def pipeline_of(run_dir: Path) -> str:
    """Return the name of the pipeline that a run belongs to.

    Raises:
        Sim2RealError: When the run has no finished stage.
    """
    return str(next(iter(finished_stages(run_dir).values())).manifest["pipeline"])


def run_folders(root: Path, pipeline: str) -> list[Path]:
    """Return a pipeline's run folders, the oldest first."""
    return sorted(f for f in (Path(root) / pipeline).glob("*") if any(attempts(f, stage) for stage in STAGES))


def newest(root: Path, pipeline: str, stage: str, run_dir: Path | None = None) -> StageFolder:
    """Return the newest finished artifact of a stage.

    Args:
        run_dir: Run folder to search first; then the newest of all runs is taken.

    Raises:
        Sim2RealError: When no run has one; the hint names the command that makes it.
    """
    # Prefer the artifact of the given run.
    here = finished(run_dir, stage) if run_dir else None
    if here is not None:
        return here
    folders = sorted((Path(root) / pipeline).glob("*"))
    candidates = [done for folder in folders if (done := finished(folder, stage)) is not None]
    if not candidates:
        # Count unfinished attempts and dry runs, which explain the error.
        others = [attempt for folder in folders for attempt in attempts(folder, stage)]
        dry = sum(attempt.dry for attempt in others)
        kinds = [(len(others) - dry, "unfinished"), (dry, "dry run" if dry == 1 else "dry runs")]
        also = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
        also = f" ({also})" if also else ""
        raise Sim2RealError(
            f"no finished {stage!r} of pipeline {pipeline!r} in {root}{also}",
            hint=f"make one with `sim2real {stage} {pipeline}`, or name another folder with --runs DIR",
        )
    return max(candidates, key=lambda c: c.manifest["started"])


def _stage_folder(run_dir: Path, stage: str) -> Path:
    """Create a stage's folder under the first free number; only the process that creates it writes into it."""
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


def _not_writable(folder: Path, error: OSError) -> Sim2RealError:
    return Sim2RealError(
        f"cannot write the run folder {folder}: {error.strerror}", hint="name a folder of your own with --runs DIR"
    )


def _readable(error: BaseException, folder: Path) -> BaseException:
    """Return the exception to show the user: an error with a hint if the disk is full, else the same exception."""
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return error
    where = f" (writing {os.fsdecode(error.filename)})" if isinstance(error.filename, str | bytes) else ""
    return Sim2RealError(
        f"the disk is full: {error.strerror}{where}",
        hint=f"free some space, or name a folder elsewhere with --runs DIR; the files written so far are in {folder}",
    )


def _failure(error: BaseException) -> tuple[str, int]:
    """Return the status and the exit code of a stage that ends with an exception."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPTED
    if isinstance(error, SystemExit | GeneratorExit):
        code = error.code if isinstance(error, SystemExit) else None
        return "interrupted", code if isinstance(code, int) else ERROR
    return "failed", error.exit_code if isinstance(error, Sim2RealError) else ERROR


def _close(
    stage: OpenStage,
    manifest: dict[str, Json],
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
