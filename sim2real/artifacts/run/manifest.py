"""A stage's ``manifest.json``: inputs, configuration, outputs and status, replaced atomically.

A lock on it shows readers that the process of the stage still runs. The kernel releases the lock when the process ends
for any reason. On a platform or file system without locks, a stage counts as running, because its end cannot be
detected.
"""

import errno
import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePath

from sim2real.artifacts.files import to_json
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
_TEXTS = ("pipeline", "stage", "status", "started")
_DRAFT = f".{MANIFEST}.tmp"
_LOCKED = (errno.EAGAIN, errno.EACCES)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Most manifests have 4 kB; manifests with long summaries are larger.
_RESERVED_BYTES = 32 * 1024
PACKAGES = ("sim2real", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "flax", "optax", "evosax", "mcap")


def read_manifest(folder: Path) -> dict[str, Json] | None:
    """Return a stage folder's manifest, or None if it is missing or malformed.

    The status is `died` if the manifest has `running` and no process holds the lock on it.
    """
    try:
        text, locked = _read_with_lock(folder / MANIFEST)
        manifest = json.loads(text)
    except (OSError, ValueError, RecursionError):
        return None
    if not _is_manifest(manifest):
        return None
    return manifest | {"status": DIED} if manifest["status"] == RUNNING and not locked else manifest


def _is_manifest(value: object) -> bool:
    """Return whether a JSON document has a manifest's entries, and its outputs are in its folder."""
    if not isinstance(value, dict) or any(not isinstance(value.get(k), str) for k in _TEXTS):
        return False
    # Outputs lie inside the stage's folder; inputs may lie elsewhere.
    for kind in ("inputs", "outputs"):
        entries = value.get(kind)
        if not isinstance(entries, dict):
            return False
        for entry in entries.values():
            if not (isinstance(entry, dict) and all(isinstance(entry.get(k), str) for k in ("path", "sha256"))):
                return False
            path = PurePath(entry["path"])
            if kind == "outputs" and (path.is_absolute() or ".." in path.parts):
                return False
    return True


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
    draft = folder / _DRAFT
    # Overwrite the reserved bytes, then cut the file to its length: this needs no new space on a full disk.
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT, 0o666), "wb") as file:
        file.write(text)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())
        # Lock before the rename: no reader finds the manifest without its lock.
        held = _held_lock(file.fileno()) if lock else None
    os.replace(draft, folder / MANIFEST)
    return held


def reserve(folder: Path) -> None:
    """Reserve disk space for the folder's next manifest, which records the stage's end even on a full disk."""
    with (folder / _DRAFT).open("wb") as file:
        file.write(b" " * _RESERVED_BYTES)
        file.flush()
        os.fsync(file.fileno())


def readable_error(error: BaseException, folder: Path) -> BaseException:
    """Return the exception to show the user: an error with a hint if the disk is full, else the same exception."""
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return error
    where = f" (writing {os.fsdecode(error.filename)})" if isinstance(error.filename, str | bytes) else ""
    return Sim2RealError(
        f"the disk is full: {error.strerror}{where}",
        hint=f"free some space, or name a folder elsewhere with --runs DIR; the files written so far are in {folder}",
    )


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
    versions_by_name: dict[str, str | None] = {"python": platform.python_version(), "platform": platform.platform()}
    for name in PACKAGES:
        versions_by_name[name] = version(name)
    return versions_by_name


def git_state(folder: Path | None = None) -> dict[str, Json] | None:
    """Return the commit of the repository that holds a folder, and whether tracked files differ from it.

    None outside of a repository, or without git.

    Args:
        folder: Default: the working directory.
    """
    safe = {"core.fsmonitor": "false", "core.hooksPath": os.devnull}

    def git(*arguments: str) -> str:
        entries = enumerate(safe.items())
        over = {
            f"GIT_CONFIG_{what}_{i}": v for i, pair in entries for what, v in zip(("KEY", "VALUE"), pair, strict=True)
        }
        done = subprocess.run(
            ["git", "--no-optional-locks", *arguments],
            cwd=folder,
            env={**os.environ, **over, "GIT_CONFIG_COUNT": str(len(safe))},
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
        return {
            "sha": git("rev-parse", "--verify", "HEAD"),
            "dirty": bool(git("status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all")),
        }
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


def _read_with_lock(path: Path) -> tuple[str, bool]:
    """Return a file's text, and whether the process that writes it holds the lock on it.

    Raises:
        OSError: When it cannot be read.
        UnicodeDecodeError: When it is no UTF-8.
    """
    while True:
        with path.open("rb") as file:
            locked = _is_locked(file.fileno())
            text = file.read().decode("utf-8")
            with suppress(FileNotFoundError):
                # The writer replaces the file before it releases the lock: read the new file if this is the old one.
                if not locked and os.stat(path).st_ino != os.fstat(file.fileno()).st_ino:
                    continue
            return text, locked


def _is_locked(fd: int) -> bool:
    """Return whether another open file holds the lock; also True without locks."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _LOCKED or error.errno in (errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)
    fcntl.flock(fd, fcntl.LOCK_UN)
    return False
