"""A readable error where JAX ends a process because another process of the training is lost.

JAX calls abort() from a thread of its own. The callback that jaxlib accepts instead fails (`std::bad_cast`, in 0.10.2)
and aborts too. So a handler of the C library catches the signal and runs Python in the thread that called abort(),
while the main thread ends the command with an error message.
"""

import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Final

GRACE_S: Final = 10.0
"""Time that the main thread has to close its files before the process ends [s]."""
_messages: list[str] = []
_handlers: list[Callable[[int], None]] = []
"""The C library calls them: they must not be garbage collected."""


def aborted() -> str:
    """Return the message if JAX has ended this process, which lives only to close its files; else ""."""
    return _messages[0] if _messages else ""


def catch_aborts(message: str, hint: str, code: int) -> None:
    """Catch SIGABRT: `aborted` then returns the message, and the process exits with ``code`` after ``GRACE_S``."""

    def handler(_: int) -> None:
        _messages.append(message)
        time.sleep(GRACE_S)
        sys.stderr.write(f"error: {message}\n\nhint: {hint}\n")
        sys.stderr.flush()
        os._exit(code)

    try:
        library, kind = ctypes.CDLL(None), ctypes.CFUNCTYPE(None, ctypes.c_int)
        library.signal.argtypes, library.signal.restype = [ctypes.c_int, kind], ctypes.c_void_p
        _handlers.append(kind(handler))
        library.signal(signal.SIGABRT, _handlers[-1])
    except (OSError, AttributeError):  # no such C library: JAX ends the process
        return
