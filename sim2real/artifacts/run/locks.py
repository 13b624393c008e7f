"""Locks on files, by which a reader sees whether the process that wrote a file is still there.

The kernel releases such a lock when the process ends, however it ends. Where the platform or the file system has no
locks, a file counts as locked: nobody can say that its writer died.
"""

from __future__ import annotations

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
    """Lock an open file; return a new file descriptor that holds the lock until it is closed, None without locks."""
    if fcntl is None:
        return None
    own = os.dup(fd)
    try:
        fcntl.flock(own, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(own)
        return None
    return own


def read_with_lock(path: Path) -> tuple[str, bool]:
    """Return a file's text, and whether the process that writes it holds the lock on it.

    Raises:
        OSError: When it cannot be read.
        UnicodeDecodeError: When it is no text.
    """
    while True:
        with path.open("rb") as file:
            locked = _is_locked(file.fileno())
            text = file.read().decode("utf-8")
            with suppress(FileNotFoundError):
                # Its writer replaces the file before it releases the lock: of the old file, nothing is to be said.
                if not locked and os.stat(path).st_ino != os.fstat(file.fileno()).st_ino:
                    continue
            return text, locked


def _is_locked(fd: int) -> bool:
    """Return whether another open file holds the lock; True, too, where there are no locks."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _HELD or error.errno in (errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)
    fcntl.flock(fd, fcntl.LOCK_UN)
    return False
