"""The cache of compiled programs between runs: a folder of bounded size that JAX reads and writes.

Imports no JAX: the folder is set in the environment, which child processes inherit, or in JAX's own configuration where
JAX was imported before.
"""

import contextlib
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from sim2real.errors import UsageError
from sim2real.installation import has_jax

VARIABLE = "SIM2REAL_CACHE"
"""Environment variable with the folder of the cache, or ``off``."""
OFF = "off"
_JAX = "JAX_COMPILATION_CACHE_DIR"
_MAX_BYTES = 2 * 2**30
"""Size to which the folder is cut when a process begins; an identification or a training adds 10 to 40 MB."""
_SETTINGS = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.0",  # a run compiles a hundred small programs: 3 s together
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def location() -> Path | None:
    """Return the folder of this machine's programs; None where the cache is off, or JAX is not installed.

    ``SIM2REAL_CACHE`` names a folder, or is ``off``; default: the platform's cache folder.
    """
    place = os.environ.get(VARIABLE)
    if place == OFF or not has_jax():
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "sim2real"
    root = Path(place).expanduser() if place else home
    if root.exists() and not root.is_dir():
        raise UsageError(
            f"the compilation cache {root} is no folder", hint=f"{VARIABLE}=DIR moves it, {VARIABLE}=off ends it"
        )
    return root / "programs" / _machine()


def enable() -> Path | None:
    """Let JAX keep compiled programs; return the folder, None where the cache is off or its folder cannot be written.

    A cache that the user configured for JAX stays as it is.
    """
    folder = location()
    if folder is None or os.environ.get(_JAX):
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:  # the home directory is read-only or full: every run compiles anew
        return None

    # Remove old programs (JAX's own limit needs a further package, and a lock for each program), then set the folder
    # for child processes, and for JAX if it was imported before.
    _cut(folder, _MAX_BYTES)
    os.environ[_JAX] = str(folder)
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    if (jax := sys.modules.get("jax")) is not None and jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def _machine() -> str:
    """Return a name that two machines share if they can run each other's programs.

    XLA compiles for the features of this machine's processor; another processor may stop at an unknown instruction.
    """
    features = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        features = next((line for line in lines if line.startswith(("flags", "Features"))), features)
    digest = hashlib.sha256(features.encode()).hexdigest()[:10]
    return f"{platform.machine()}-{digest}-jaxlib-{metadata.version('jaxlib')}"


def _entries(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Yield last use [s since the epoch], size [bytes] and path of each program."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            with contextlib.suppress(OSError):  # another process has just removed it
                if entry.name.endswith("-cache"):
                    status = entry.stat()
                    yield max(status.st_atime, status.st_mtime), status.st_size, Path(entry.path)


def _cut(folder: Path, max_bytes: int) -> None:
    """Remove the least recently used programs until the folder holds at most ``max_bytes``."""
    entries = sorted(_entries(folder), reverse=True)
    total = 0
    for _, size, path in entries:
        total += size
        if total > max_bytes:
            with contextlib.suppress(OSError):
                path.unlink()
