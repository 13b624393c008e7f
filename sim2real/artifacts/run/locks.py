"""Locks on files: a lock shows readers that the process that writes the file still runs.

The kernel releases the lock when the process ends for any reason. On a platform or file system without locks, a file
counts as locked, because the end of its writer cannot be detected.
"""

import errno
import os
from contextlib import suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_HELD = (errno.EAGAIN, errno.EACCES)


def held_lock(fd: int) -> int | None:
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


def read_with_lock(path: Path) -> tuple[str, bool]:
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
        return error.errno in _HELD or error.errno in (errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)
    fcntl.flock(fd, fcntl.LOCK_UN)
    return False
