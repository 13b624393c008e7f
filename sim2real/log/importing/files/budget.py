"""Limits on the memory and time that a file of another recorder takes; all readers of such files apply them."""

import math
from collections.abc import Sequence
from pathlib import Path

from sim2real.errors import UsageError

WHOLE = "check that the file is complete, and that its name or --format gives the right format"
"""The hint for damaged content."""
MAX_BYTES = 1 << 30
"""Limit of the memory of a file's numbers [bytes]: 37 minutes of 60 columns at 1 kHz."""
MAX_TEXT_BYTES = 1 << 28
"""Largest JSON document [bytes]; in memory it takes about ten times as much."""
MAX_SIGNALS = 10_000
"""A file has at most this many signals."""
MAX_COLUMNS = 1000
"""A signal of joints has at most this many columns; one with more is an image."""
MAX_LEVELS = 64
"""Deepest nesting of a document."""
_WORD_BYTES = 64
"""Memory of a word before it becomes a number [bytes]."""


def require_size(path: Path, most: int = MAX_BYTES) -> None:
    """Raise a UsageError if a text file is larger than the limit."""
    size = path.stat().st_size
    if size > most:
        raise UsageError(
            f"{path} has {size / 2**20:.0f} MiB; at most {most / 2**20:.0f} MiB of this format are read",
            hint="save it as npz, or cut it into parts",
        )


def require_memory(size: float, what: str) -> None:
    """Raise a UsageError if numbers take more memory than the limit.

    Args:
        size: Their memory [bytes].
        what: Name of the numbers, for the error.
    """
    if size > MAX_BYTES:
        raise UsageError(
            f"{what} takes {size / 2**20:.0f} MiB of memory; at most {MAX_BYTES / 2**20:.0f} MiB are read",
            hint="cut the recording into parts",
        )


def require_signals(count: int, path: Path) -> None:
    """Raise a UsageError if a file has more signals than the limit."""
    if count > MAX_SIGNALS:
        raise UsageError(
            f"{path} has {count} signals; at most {MAX_SIGNALS} are read", hint="save the joints' signals alone"
        )


def reason_to_skip(shape: Sequence[int], kind: str, itemsize: int) -> str:
    """Return why an array cannot be a signal of a robot; empty if it can.

    Args:
        kind: NumPy's ``dtype.kind``.
        itemsize: Size of an element [bytes].
    """
    if kind not in "fiubMmUS":  # words can be dates, or numbers
        return "no numbers"
    if len(shape) > 2:
        return f"{len(shape)} dimensions, as of images"
    if len(shape) == 2 and shape[1] > MAX_COLUMNS:
        return f"{shape[1]} columns, as of images"
    if math.prod(shape) * max(itemsize, _WORD_BYTES if kind in "US" else 8) > MAX_BYTES:
        return f"larger than {MAX_BYTES / 2**20:.0f} MiB"
    return ""
