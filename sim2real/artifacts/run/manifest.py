"""A stage's ``manifest.json``: inputs, configuration, outputs and status, replaced atomically.

A lock on it shows readers that the process of the stage still runs. The kernel releases the lock when the process ends
for any reason. On a platform or file system without locks, a stage counts as running, because its end cannot be
detected.
"""

import errno
import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePath

import msgspec

from sim2real.artifacts.files import replacing, to_json
from sim2real.errors import Sim2RealError
from sim2real.installation import version
from sim2real.types import Json

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MANIFEST = "manifest.json"
RUNNING = "running"
DIED = "died"
"""Status of a stage whose process ended without writing its end: it was killed, or the machine lost its power."""
_LOCKED = (errno.EAGAIN, errno.EACCES)
_NO_LOCKS = (errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)
_RESERVED_BYTES = 32 * 1024
"""Most manifests have 4 kB; manifests with long summaries are larger."""
PACKAGES = ("sim2real", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "flax", "optax", "evosax", "mcap")


@dataclass(frozen=True)
class _File:
    """An input or an output; a path is relative to the run folder, that of an output to the stage's folder."""

    path: str
    sha256: str


@dataclass(frozen=True)
class _Manifest:
    """The entries that each manifest has."""

    pipeline: str
    stage: str
    status: str
    started: str
    inputs: dict[str, _File]
    outputs: dict[str, _File]


def read_manifest(folder: Path) -> dict[str, Json] | None:
    """Return a stage folder's manifest, or None if it is missing or malformed, or names outputs outside of the folder.

    The status is `died` if the manifest has `running` and no process holds the lock on it.
    """
    try:
        text, locked = _read_with_lock(folder / MANIFEST)
        manifest = msgspec.json.decode(text)
        document = msgspec.convert(manifest, _Manifest)
    except (OSError, ValueError, msgspec.MsgspecError, RecursionError):
        return None
    paths = [PurePath(file.path) for file in document.outputs.values()]
    if any(path.is_absolute() or ".." in path.parts for path in paths):
        return None
    return manifest | {"status": DIED} if document.status == RUNNING and not locked else manifest


def write_manifest(folder: Path, manifest: Mapping[str, Json], lock: bool = False) -> int | None:
    """Write a stage folder's manifest; a reader finds the old one or the new one, never a part.

    Args:
        lock: Whether to hold a lock on it, which shows readers that this process runs.

    Returns:
        The file descriptor that holds the lock; its owner closes it. None without a lock.

    Raises:
        TypeError: When a value has no plain JSON form.
    """
    text = to_json(manifest)
    # Lock before the rename: no reader finds the manifest without its lock.
    with replacing(folder / MANIFEST) as file:
        file.write(text)
        return _held_lock(file.fileno()) if lock else None


def reserve(folder: Path) -> None:
    """Reserve disk space for the folder's next manifest, which records the stage's end even on a full disk."""
    with (folder / f".{MANIFEST}.tmp").open("wb") as file:
        file.write(b" " * _RESERVED_BYTES)
        file.flush()
        os.fsync(file.fileno())


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
    safe = {"core.fsmonitor": "false", "core.hooksPath": os.devnull}

    def git(*arguments: str) -> str:
        settings = {f"GIT_CONFIG_KEY_{i}": key for i, key in enumerate(safe)}
        settings |= {f"GIT_CONFIG_VALUE_{i}": value for i, value in enumerate(safe.values())}
        done = subprocess.run(
            ["git", "--no-optional-locks", *arguments],
            cwd=folder,
            env={**os.environ, **settings, "GIT_CONFIG_COUNT": str(len(safe))},
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        return done.stdout.strip()

    try:
        # Switch off programs in the repository's settings that git would run (file system monitors, hooks, filters),
        # because the repository can come from an unknown source. The user's own settings stay.
        for line in git("config", "--list", "--name-only", "--show-scope").splitlines():
            scope, _, key = line.partition("\t")
            if scope in ("local", "worktree") and key.startswith("filter."):
                safe[key] = "false" if key.endswith(".required") else ""
        dirty = git("status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all")
        return {"sha": git("rev-parse", "--verify", "HEAD"), "dirty": bool(dirty)}
    except (OSError, subprocess.SubprocessError):
        return None


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
                    locked = error.errno in _LOCKED + _NO_LOCKS
            text = file.read()
            with suppress(FileNotFoundError):
                # The writer replaces the file before it releases the lock: read the new file if this is the old one.
                if not locked and os.stat(path).st_ino != os.fstat(file.fileno()).st_ino:
                    continue
            return text, locked
