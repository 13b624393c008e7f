"""The end of a command that failed: its message, its exit code, and the end of its process."""

import contextlib
import os
import signal
import sys
import tempfile
import traceback
from textwrap import shorten
from typing import NoReturn

from sim2real.errors import ERROR, Sim2RealError, UsageError
from sim2real.stages.terminal.console import clean

DEBUG = "SIM2REAL_DEBUG"


def failed(error: Sim2RealError) -> int:
    """Print the error's message, notes and hint; return its exit code."""
    if os.environ.get(DEBUG):
        traceback.print_exc()
    # Notes name nodes, and what else failed during the clean-up; the hint comes last.
    message, *hint = str(error).split("\n\nhint: ", 1)
    if not hint and isinstance(error, UsageError):
        hint = ["see `sim2real COMMAND --help`"]
    _complain(f"error: {message}", *_notes(error), *(f"\nhint: {h}" for h in hint))
    return error.exit_code


def refused(error: OSError) -> int:
    """Print an operating system's error about a file; return the exit code."""
    if not isinstance(error.filename, str | bytes):
        return unexpected(error)
    if os.environ.get(DEBUG):
        traceback.print_exc()
    name = shorten(os.fsdecode(error.filename), 200)
    _complain(f"error: {error.strerror}: {name}", *_notes(error), f"\nhint: check its name; {DEBUG}=1 shows more")
    return ERROR


def unexpected(error: Exception) -> int:
    """Print an unexpected exception, and save its traceback to a file; return the exit code."""
    if os.environ.get(DEBUG):
        traceback.print_exc()
    reason = " ".join(str(error).split()) or "no message"
    _complain(f"error: {type(error).__name__}: {reason} ({_save_traceback()})", *_notes(error))
    return ERROR


def ended_by(number: int) -> int:
    """Print which signal ended the command; return the exit code."""
    _complain("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")
    return 128 + number


def leave(code: int) -> NoReturn:
    """End this process at once, without the interpreter's shutdown; for commands that ended early.

    A compiled program that is still running in XLA's threads would make the interpreter's shutdown wait for it, or end
    in a segmentation fault. Open logs are closed before: their status is ``aborted``.
    """
    if writer := sys.modules.get("sim2real.log.writer"):
        writer.close_open_logs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _complain(*lines: str) -> None:
    print(clean("\n".join(lines)), file=sys.stderr)


def _notes(error: BaseException) -> list[str]:
    """Return an exception's notes, each as one line."""
    return [f"  {' '.join(note.split())}" for note in getattr(error, "__notes__", [])]


def _save_traceback() -> str:
    """Write the traceback of the current exception to a file; return a text with its path."""
    try:
        with tempfile.NamedTemporaryFile("w", prefix="sim2real-", suffix=".traceback.txt", delete=False) as file:
            file.write(traceback.format_exc())
    except OSError:  # e.g. a full disk, which may be the exception itself
        return f"{DEBUG}=1 shows the traceback"
    return f"traceback in {file.name}"
