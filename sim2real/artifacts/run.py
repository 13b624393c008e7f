"""Run folders: ``runs/<pipeline>/<time>/{record,identify,train,deploy}/``, each with a ``manifest.json``.

A repeated stage in the same run folder gets ``<stage>.2``, ``<stage>.3``, ...; each process creates the folder into
which it writes, and folders are never renamed. So two processes never write into the same folder, files are never
overwritten, references to files stay valid, and a failed attempt does not hide a finished one.

A manifest has a stage's inputs, configuration, outputs and status, and is replaced atomically. A lock on it shows
readers that the process of the stage still runs. The kernel releases the lock when the process ends for any reason. On
a platform or file system without locks, a stage counts as running, because its end cannot be detected.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePath

import msgspec

from sim2real.artifacts.files import plain, replacing, to_json
from sim2real.errors import ERROR, OK, Sim2RealError, UsageError
from sim2real.installation import version
from sim2real.types import Json

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

STAGES = ("record", "identify", "train", "deploy")
TAKES = {"identify": ("record", "log"), "train": ("identify", "parameters"), "deploy": ("train", "bundle")}
"""Stage -> the stage before it, and which output of that stage it reads."""
MANIFEST = "manifest.json"
RUNNING, FINISHED, FAILED, INTERRUPTED = "running", "finished", "failed", "interrupted"
DRY = "dry run"
"""Status of a finished stage that sent no commands, and that later stages therefore ignore."""
DIED = "died"
"""Status of a stage whose process ended without writing its end: it was killed, or the machine lost its power."""
SIGINT_CODE = 130
PACKAGES = ("sim2real", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "flax", "optax", "evosax", "mcap")
_RESERVED_BYTES = 32 * 1024
"""Reserved size of a manifest [bytes]: most have 4 kB."""
_NAME = re.compile(r"\w[\w.-]*")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LOCKED_OR_NO_LOCKS = (errno.EAGAIN, errno.EACCES, errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)


@dataclass(frozen=True)
class Source:
    """A file and its SHA-256 ("" without a file). Paths are relative to the run folder; outputs, to the stage's."""

    path: str
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """The record of one attempt at a stage.

    Attributes:
        status: ``running``, ``finished``, ``dry run``, ``failed``, ``interrupted`` or, of a killed process, ``died``.
        started: Time in UTC.
        command: The command line.
        config: The resolved configuration.
        git: Commit of the repository of the working directory, and whether tracked files differ from it.
        error: Why the stage failed.
    """

    pipeline: str
    stage: str
    status: str
    started: str
    inputs: dict[str, Source] = field(default_factory=dict)
    outputs: dict[str, Source] = field(default_factory=dict)
    dry_run: bool = False
    exit_code: int | None = None
    duration_s: float | None = None
    command: list[str] = field(default_factory=list)
    config: Json = None
    summary: dict[str, Json] = field(default_factory=dict)
    versions: dict[str, str | None] = field(default_factory=dict)
    git: dict[str, Json] | None = None
    error: str = ""
    format: int = 1


@dataclass(frozen=True)
class StageFolder:
    """A stage's folder and its manifest."""

    folder: Path
    manifest: Manifest

    @staticmethod
    def read(folder: Path) -> StageFolder | None:
        """Return a stage's folder; None if its manifest is missing or malformed, or names files outside of the folder.

        The status is ``died`` if the manifest has ``running`` and no process holds the lock on it.
        """
        try:
            text, locked = _read_with_lock(folder / MANIFEST)
            manifest = msgspec.json.decode(text, type=Manifest)
        except (OSError, ValueError, RecursionError):
            return None
        paths = [PurePath(output.path) for output in manifest.outputs.values()]
        if any(path.is_absolute() or ".." in path.parts for path in paths):
            return None
        if manifest.status == RUNNING and not locked:
            manifest = replace(manifest, status=DIED)
        return StageFolder(folder, manifest)

    @property
    def run_dir(self) -> Path:
        """The run folder it lies in."""
        return self.folder.parent

    @property
    def stage(self) -> str:
        """The stage's name."""
        return self.manifest.stage

    @property
    def finished(self) -> bool:
        """Whether the stage finished."""
        return self.manifest.status == FINISHED

    @property
    def outputs(self) -> dict[str, Path]:
        """Name -> path of each output."""
        return {name: self.folder / output.path for name, output in self.manifest.outputs.items()}

    def logs(self) -> list[Path]:
        """Return the logs of a recording; an imported data set has a log for each episode."""
        names = [name for name in self.outputs if name == "log" or name.startswith("log_")]
        return [self.output(name) for name in sorted(names, key=lambda name: (len(name), name)) or ["log"]]

    def output(self, name: str) -> Path:
        """Return the path of one output.

        Raises:
            Sim2RealError: The stage has no such output, or the file was deleted.
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


# -- a running stage


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
        """Register an output by its path in the stage's folder; return the absolute path. It is hashed at the end."""
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
        UsageError: The name of the stage or the pipeline is no valid folder name.
        Sim2RealError: An input, or an output after the block, does not exist, or the disk is full.
    """
    # Refuse names that would lead out of the folder of runs: a pipeline's name may come from a file.
    if not stage.isidentifier():
        raise UsageError(f"{stage!r} is no name for a stage", hint="letters, digits and '_'; a letter first")
    if not _NAME.fullmatch(pipeline):
        raise UsageError(
            f"{pipeline!r} is no name for a pipeline", hint="letters, digits, '_', '-' and '.'; a letter or digit first"
        )
    # Hash the inputs first, because files may change while the stage runs for hours.
    hashes = {name: sha256(Path(path)) for name, path in (inputs or {}).items()}
    folder = _stage_folder(run_dir or new_run(root, pipeline), stage)
    manifest = Manifest(
        pipeline=pipeline,
        stage=stage,
        status=RUNNING,
        started=datetime.now(UTC).isoformat(timespec="microseconds"),
        inputs={n: Source(portable(Path(p), folder.parent), hashes[n]) for n, p in (inputs or {}).items()},
        dry_run=dry_run,
        command=sys.argv,
        config=config,
        versions=versions(),
        git=git_state(),
    )
    # Write the first manifest with a lock, then run the stage and write the last manifest.
    running = OpenStage(folder)
    begun_s, lock = time.monotonic(), None
    try:
        lock = write_manifest(folder, manifest, lock=True)
        _reserve(folder)
        yield running
        _close(running, manifest, begun_s, DRY if dry_run else FINISHED, OK)
    except BaseException as error:
        failure = _readable(error, folder)
        try:
            _close(running, manifest, begun_s, *_status_of(failure), failure)
        except OSError as other:
            failure.add_note(f"then: the manifest could not be written: {other}")
        if failure is error:
            raise
        raise failure from error
    finally:
        if lock is not None:
            os.close(lock)


def _close(
    stage: OpenStage,
    manifest: Manifest,
    begun_s: float,
    status: str,
    code: int,
    error: BaseException | None = None,
) -> None:
    """Write the last manifest; a stage that failed lists only the outputs that exist."""
    paths = stage._outputs if error is None else {n: p for n, p in stage._outputs.items() if p.exists()}
    last = replace(
        manifest,
        status=status,
        exit_code=code,
        outputs={n: Source(p.relative_to(stage.folder).as_posix(), sha256(p)) for n, p in paths.items()},
        summary=stage._summary,
        duration_s=round(time.monotonic() - begun_s, 3),
    )
    if error is not None:
        text = "\n".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
        last = replace(last, error=text)
    write_manifest(stage.folder, last)
    stage._result = StageFolder.read(stage.folder) or StageFolder(stage.folder, last)


def _status_of(error: BaseException) -> tuple[str, int]:
    """Return the status and the exit code of a stage that ends with an exception."""
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, SIGINT_CODE
    if isinstance(error, SystemExit | GeneratorExit):
        code = error.code if isinstance(error, SystemExit) else None
        return INTERRUPTED, code if isinstance(code, int) else ERROR
    return FAILED, error.exit_code if isinstance(error, Sim2RealError) else ERROR


def _readable(error: BaseException, folder: Path) -> BaseException:
    """Return the exception to show the user: an error with a hint if the disk is full, else the same exception."""
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return error
    where = f" (writing {os.fsdecode(error.filename)})" if isinstance(error.filename, str | bytes) else ""
    return Sim2RealError(
        f"the disk is full: {error.strerror}{where}",
        hint=f"free some space, or name a folder elsewhere with --runs DIR; the files written so far are in {folder}",
    )


def new_run(root: Path, pipeline: str) -> Path:
    """Create a run folder named by the time (UTC, to the millisecond); the names are unique and sort by age."""
    while True:
        now = datetime.now(UTC)
        folder = Path(root) / pipeline / f"{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}"
        if _made(folder):
            return folder
        time.sleep(0.001)  # two runs started in the same millisecond


def _stage_folder(run_dir: Path, stage: str) -> Path:
    """Create a stage's folder under the first free number; only the process that creates it writes into it."""
    number = 1
    while not _made(folder := run_dir / (stage if number == 1 else f"{stage}.{number}")):
        number += 1
    return folder


def _made(folder: Path) -> bool:
    """Create a folder; return False if it exists."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return False
    except OSError as error:
        raise Sim2RealError(
            f"cannot write the run folder {folder}: {error.strerror}", hint="name a folder of your own with --runs DIR"
        ) from error
    return True


# -- finding stages


def attempts(run_dir: Path, stage: str) -> list[StageFolder]:
    """Return all attempts at a stage in a run folder, by descending number, as clocks can be set back."""
    numbers = [int(f.suffix[1:]) for f in run_dir.glob(f"{stage}.*") if f.suffix[1:].isdecimal()]
    folders = [*(run_dir / f"{stage}.{n}" for n in sorted(numbers, reverse=True)), run_dir / stage]
    return [attempt for folder in folders if (attempt := StageFolder.read(folder)) is not None]


def finished(run_dir: Path, stage: str) -> StageFolder | None:
    """Return the latest finished attempt at a stage in a run folder, or None."""
    return next((attempt for attempt in attempts(run_dir, stage) if attempt.finished), None)


def finished_stages(run_dir: Path) -> dict[str, StageFolder]:
    """Return stage -> its latest finished attempt, in the order of the stages; a dry run if there is no other.

    Raises:
        Sim2RealError: When no stage is finished.
    """
    latest = {}
    for stage in STAGES:
        done = [a for a in attempts(run_dir, stage) if a.manifest.status in (FINISHED, DRY)]
        if done:
            latest[stage] = next((a for a in done if a.finished), done[0])
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
    return next(iter(finished_stages(run_dir).values())).manifest.pipeline


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
    if run_dir and (here := finished(run_dir, stage)) is not None:
        return here
    folders = sorted((Path(root) / pipeline).glob("*"))
    candidates = [done for folder in folders if (done := finished(folder, stage)) is not None]
    if not candidates:
        # Count unfinished attempts and dry runs, which explain the error.
        others = [attempt.manifest.dry_run for folder in folders for attempt in attempts(folder, stage)]
        kinds = [(others.count(False), "unfinished"), (others.count(True), "dry run" + "s" * (others.count(True) > 1))]
        also = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
        raise Sim2RealError(
            f"no finished {stage!r} of pipeline {pipeline!r} in {root}{f' ({also})' if also else ''}",
            hint=f"make one with `sim2real {stage} {pipeline}`, or name another folder with --runs DIR",
        )
    return max(candidates, key=lambda c: c.manifest.started)


# -- whether a stage is up to date, by the hashes in manifests, so that large logs are not read


@dataclass(frozen=True)
class StageStatus:
    """The status of a stage of a run.

    Attributes:
        stale: The reason if it is out of date; "" if it is current.
    """

    newest: StageFolder
    stale: str = ""


def stage_status(run_dir: Path) -> dict[str, StageStatus]:
    """Return stage -> status, in the order of the stages; a stage without a finished attempt has no entry."""
    status: dict[str, StageStatus] = {}
    for stage in STAGES:
        if (done := finished(run_dir, stage)) is not None:
            status[stage] = StageStatus(done, why_stale(done, status))
    return status


def why_stale(attempt: StageFolder, status: Mapping[str, StageStatus]) -> str:
    """Return why a finished attempt is out of date; "" if it is current.

    A stage is current if it was made from the newest finished attempt at the stage before it, and if that one is
    current.
    """
    before, output = TAKES.get(attempt.stage, ("", ""))
    if before not in status:
        return ""  # the run began with this stage: its inputs come from elsewhere
    source = status[before]
    name, source_name = attempt.folder.name, source.newest.folder.name
    if not _made_from(attempt, source.newest, output):
        return f"{name} was not made from {source_name}, the newest {before}: the hashes of its {output} differ"
    return f"{name} was made from {source_name}, which is out of date" if source.stale else ""


def _made_from(attempt: StageFolder, source: StageFolder, output: str) -> bool:
    """Return whether one of a stage's inputs is an output of the stage before it."""
    manifest = attempt.manifest
    if attempt.stage == "train" and (manifest.config or {}).get("model") == "nominal":
        return True  # a policy for the nominal model does not depend on an identification
    inputs = {entry.sha256 for entry in manifest.inputs.values()}
    entry = source.manifest.outputs.get(output)
    if entry is not None and entry.sha256 in inputs:
        return True
    # An identification may read logs of a deployment, or of the user. It is out of date when the robot is recorded
    # # again.
    if attempt.stage != "identify" or not inputs:
        return False
    recorded = {e.sha256 for a in attempts(attempt.run_dir, "record") for e in a.manifest.outputs.values()}
    return not inputs & recorded and manifest.started > source.manifest.started


# -- manifests and their locks


def write_manifest(folder: Path, manifest: Manifest, lock: bool = False) -> int | None:
    """Write a stage folder's manifest; a reader finds the old one or the new one, never a part.

    Args:
        lock: Whether to hold a lock on it, which shows readers that this process runs.

    Returns:
        The file descriptor that holds the lock; its owner closes it. None without a lock.

    Raises:
        TypeError: A value has no form in JSON.
    """
    text = to_json(manifest)
    # Lock before the rename: no reader finds the manifest without its lock.
    with replacing(folder / MANIFEST) as file:
        file.write(text)
        return _held_lock(file.fileno()) if lock else None


def _reserve(folder: Path) -> None:
    """Reserve disk space for the folder's next manifest, which records the stage's end even on a full disk."""
    with (folder / f".{MANIFEST}.tmp").open("wb") as file:
        file.write(b" " * _RESERVED_BYTES)
        file.flush()
        os.fsync(file.fileno())


def _held_lock(fd: int) -> int | None:
    """Lock an open file; return a new file descriptor that holds the lock until it is closed, or None without locks."""
    if fcntl is None:
        return None
    duplicate = os.dup(fd)
    try:
        fcntl.flock(duplicate, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(duplicate)
        return None
    return duplicate


def _read_with_lock(path: Path) -> tuple[bytes, bool]:
    """Return a file's bytes, and whether the process that writes it holds the lock on it; also True without locks."""
    while True:
        with path.open("rb") as file:
            locked = True
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    fcntl.flock(file, fcntl.LOCK_UN)
                    locked = False
                except OSError as error:
                    locked = error.errno in _LOCKED_OR_NO_LOCKS
            text = file.read()
            with suppress(FileNotFoundError):
                # The writer replaces the file before it releases the lock: read the new file if this is the old one.
                if not locked and os.stat(path).st_ino != os.fstat(file.fileno()).st_ino:
                    continue
            return text, locked


# -- hashes and versions on which results depend


def portable(path: Path, run_dir: Path) -> str:
    """Return a path relative to the run folder, so that a moved or copied run finds its files."""
    return Path(os.path.relpath(path.resolve(), run_dir.resolve())).as_posix()


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder: of its files' relative names and hashes in order of name.

    Raises:
        Sim2RealError: When there is no such file or folder.
    """
    if path.is_dir():
        digest = hashlib.sha256()
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            digest.update(f"{file.relative_to(path).as_posix()}\0{sha256(file)}\n".encode())
        return digest.hexdigest()
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise Sim2RealError(f"cannot read {path}: {error.strerror}") from error


def versions() -> dict[str, str | None]:
    """Return the versions of the packages that affect results; None for a missing package."""
    system = {"python": platform.python_version(), "platform": platform.platform()}
    return {**system, **{name: version(name) for name in PACKAGES}}


def git_state(folder: Path | None = None) -> dict[str, Json] | None:
    """Return the commit of the repository that holds a folder, and whether tracked files differ from it.

    None outside of a repository, or without git.

    Args:
        folder: Default: the working directory.
    """
    command = ["git", "--no-optional-locks", "describe", "--always", "--exclude=*", "--abbrev=40", "--dirty"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    sha, _, dirty = done.stdout.strip().partition("-")
    return {"sha": sha, "dirty": bool(dirty)}
