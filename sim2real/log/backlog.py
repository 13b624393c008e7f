"""What waits in the queue of a log's writer: a slow writer is told from a stuck disk, and the memory has a bound."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Final

RECORD_BYTES: Final = 500
"""Memory of a record that waits, besides its arrays: measured, 450 bytes a step of six numbers."""
_MOST_BYTES: Final = 2**30
_LATE_S: Final = 1.0
STUCK_S: Final = 60.0
"""So long without one record written, the disk is stuck: longer than any working disk needs for one."""


@dataclass(frozen=True)
class Backlog:
    """What the writer of a log still has to write.

    Attributes:
        records: Number of records that wait.
        bytes: Their memory, estimated.
        behind_s: How long ago the record was queued that is written now; 0 where none waits.
        idle_s: How long the writer has been busy with one record, or one flush; 0 where none waits.
    """

    records: int
    bytes: int
    behind_s: float
    idle_s: float

    @property
    def late(self) -> bool:
        """Whether the writer is so far behind that the user should know."""
        return self.records > 0 and self.behind_s > _LATE_S

    @property
    def stuck(self) -> bool:
        """Whether the disk takes no data, rather than the writer being slow."""
        return self.idle_s > STUCK_S

    def __str__(self) -> str:
        """Return a sentence for the user."""
        waiting = f"{self.records:,} records ({self.bytes / 1e6:.0f} MB) wait"
        if self.idle_s > max(_LATE_S, 0.5 * self.behind_s):
            return f"the disk has taken no data for {self.idle_s:.0f} s; {waiting}"
        return f"the writer of the log is {self.behind_s:.1f} s behind; {waiting}, the disk takes data"


def most_bytes() -> int:
    """Return how much memory the records that wait may take: 1 GiB, or a quarter of a smaller machine's memory."""
    try:
        return min(_MOST_BYTES, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4)
    except (AttributeError, ValueError, OSError):  # not on every platform
        return _MOST_BYTES
