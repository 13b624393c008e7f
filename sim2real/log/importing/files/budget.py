"""What a file of another recorder may cost: limits that every reader of such files keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from sim2real.errors import UsageError

WHOLE = "check that the file is complete, and of the format that its name or --format says"
"""The hint for damaged content."""
MOST_BYTES = 1 << 30
"""A file's numbers take at most this much memory [bytes]: 37 minutes of 60 columns at 1 kHz."""
MOST_TEXT_BYTES = 1 << 28
"""A JSON document has at most this size [bytes]; in memory it takes some ten times as much."""
MOST_SIGNALS = 10_000
"""A file has at most this many signals."""
MOST_COLUMNS = 1000
"""A signal of joints has at most this many columns; one with more is an image."""
MOST_LEVELS = 64
"""A document is nested at most this deep."""
_WORD_BYTES = 64
"""What a word takes in memory until its number is known [bytes]."""


def require_size(path: Path, most: int = MOST_BYTES) -> None:
    """Refuse a file of text that is larger than the budget.

    Raises:
        UsageError: When it is.
    """
    size = path.stat().st_size
    if size > most:
        raise UsageError(
            f"{path} has {size / 2**20:.0f} MiB; at most {most / 2**20:.0f} MiB of this format are read",
            hint="save it as npz, or cut it into parts",
        )


def require_memory(size: float, what: str) -> None:
    """Refuse to load numbers that take more memory than the budget.

    Args:
        size: What they take [bytes].
        what: The numbers, for the error.

    Raises:
        UsageError: When they take more.
    """
    if size > MOST_BYTES:
        raise UsageError(
            f"{what} takes {size / 2**20:.0f} MiB of memory; at most {MOST_BYTES / 2**20:.0f} MiB are read",
            hint="cut the recording into parts",
        )


def require_signals(count: int, path: Path) -> None:
    """Refuse a file with more signals than the budget.

    Raises:
        UsageError: When it has more.
    """
    if count > MOST_SIGNALS:
        raise UsageError(
            f"{path} has {count} signals; at most {MOST_SIGNALS} are read", hint="save the joints' signals alone"
        )


def why_left_out(shape: Sequence[int], kind: str, itemsize: int) -> str:
    """Return why an array is no signal that a mapping is proposed from; empty where it may be one.

    Args:
        shape: Its shape.
        kind: Of its elements, as numpy's ``dtype.kind``.
        itemsize: Size of an element [bytes].
    """
    if kind not in "fiubMmUS":  # words may be dates, or numbers that were saved as words
        return "no numbers"
    if len(shape) > 2:
        return f"{len(shape)} dimensions, as of images"
    if len(shape) == 2 and shape[1] > MOST_COLUMNS:
        return f"{shape[1]} columns, as of images"
    if math.prod(shape) * max(itemsize, _WORD_BYTES if kind in "US" else 8) > MOST_BYTES:
        return f"larger than {MOST_BYTES / 2**20:.0f} MiB"
    return ""
