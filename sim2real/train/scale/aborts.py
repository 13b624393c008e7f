"""What becomes of JAX's way to end a process whose neighbour is lost: it calls abort(), from a thread of its own.

The callback that jaxlib takes in its place fails in a conversion of its own (`std::bad_cast`, in 0.10.2) and aborts as
well. So the signal is caught by a handler of the C library, which runs Python in the thread that called abort(), while
the main thread ends the command in words.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from typing import Any, Final

GRACE_S: Final = 10.0
"""How long the main thread may take to close its files before the process ends all the same."""
_said: list[str] = []
_kept: list[Any] = []  # the C library calls it: it must not be collected


def aborted() -> str:
    """Return the words for it where JAX has ended this process, which lives only to close its files; else ""."""
    return _said[0] if _said else ""


def catch_aborts(words: str, hint: str, code: int) -> None:
    """Catch SIGABRT: `aborted` returns the words from then on; a process that does not end soon is ended with them."""

    def handler(_: int) -> None:
        _said.append(words)
        time.sleep(GRACE_S)
        sys.stderr.write(f"error: {words}\n\nhint: {hint}\n")
        sys.stderr.flush()
        os._exit(code)

    try:
        library, kind = ctypes.CDLL(None), ctypes.CFUNCTYPE(None, ctypes.c_int)
        library.signal.argtypes, library.signal.restype = [ctypes.c_int, kind], ctypes.c_void_p
        _kept.append(kind(handler))
        library.signal(signal.SIGABRT, _kept[-1])
    except (OSError, AttributeError):  # no such C library: JAX ends the process
        return
