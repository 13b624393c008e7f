"""How a command that failed ends: what it says, its exit code, and its process."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import tempfile
import traceback
from textwrap import shorten
from typing import NoReturn

from sim2real.errors import ERROR, Sim2RealError, UsageError
from sim2real.stages.console import clean

DEBUG = "SIM2REAL_DEBUG"


def failed(error: Sim2RealError) -> int:
    """Say what went wrong and return the exit code that stands for it."""
    if os.environ.get(DEBUG):
        traceback.print_exc()
    # The notes name nodes and what failed on the way out; the hint stays last.
    message, *hint = str(error).split("\n\nhint: ", 1)
    if not hint and isinstance(error, UsageError):
        hint = ["see `sim2real COMMAND --help`"]
    _complain(f"error: {message}", *_notes(error), *(f"\nhint: {h}" for h in hint))
    return error.exit_code


def refused(error: OSError) -> int:
    """Say what the operating system refused, and about which file; return the exit code."""
    if not isinstance(error.filename, str | bytes):
        return unexpected(error)
    if os.environ.get(DEBUG):
        traceback.print_exc()
    name = shorten(os.fsdecode(error.filename), 200)
    _complain(f"error: {error.strerror}: {name}", *_notes(error), f"\nhint: check its name; {DEBUG}=1 shows more")
    return ERROR


def unexpected(error: Exception) -> int:
    """Say which error nobody foresaw, and where its traceback is; return the exit code."""
    if os.environ.get(DEBUG):
        traceback.print_exc()
    reason = " ".join(str(error).split()) or "no message"
    _complain(f"error: {type(error).__name__}: {reason} ({_save_traceback()})", *_notes(error))
    return ERROR


def ended_by(number: int) -> int:
    """Say which signal ended the command and return its exit code."""
    _complain("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")
    return 128 + number


def leave(code: int) -> NoReturn:
    """End this process, which is a command that ended early, at once.

    Everything of ours has been unwound by now. But a program of XLA's that was begun goes on in threads of its own, and
    taking the interpreter down under them is a segmentation fault, or a wait until they are done.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _complain(*lines: str) -> None:
    print(clean("\n".join(lines)), file=sys.stderr)


def _notes(error: BaseException) -> list[str]:
    """Return an exception's notes, one line each."""
    return [f"  {' '.join(note.split())}" for note in getattr(error, "__notes__", [])]


def _save_traceback() -> str:
    """Write the traceback of the exception at hand to a file and say where it is."""
    try:
        with tempfile.NamedTemporaryFile("w", prefix="sim2real-", suffix=".traceback.txt", delete=False) as file:
            file.write(traceback.format_exc())
    except OSError:  # a full disk, perhaps the very error at hand
        return f"{DEBUG}=1 shows the traceback"
    return f"traceback in {file.name}"
