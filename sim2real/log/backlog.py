"""The backlog of a log's writer: it distinguishes a slow writer from a stuck disk, and limits the queue's memory."""

import os
from dataclasses import dataclass
from typing import Final

RECORD_BYTES: Final = 500
"""Memory of a queued record without its arrays [bytes]."""
_MAX_BYTES: Final = 2**30
_LATE_S: Final = 1.0
STUCK_S: Final = 60.0
"""The disk is stuck if one record takes longer [s]."""


@dataclass(frozen=True)
class Backlog:
    """The records that the writer of a log has not written yet.

    Attributes:
        behind_s: Age of the record that is being written [s]; 0 for an empty queue.
        idle_s: Time since the writer began the present record or flush [s]; 0 for an empty queue.
    """

    records: int
    bytes: int
    behind_s: float
    idle_s: float

    @property
    def late(self) -> bool:
        """Whether the writer is far enough behind for a warning."""
        return self.records > 0 and self.behind_s > _LATE_S

    @property
    def stuck(self) -> bool:
        """Whether the disk takes no data."""
        return self.idle_s > STUCK_S

    def __str__(self) -> str:
        """Return a sentence for the user."""
        waiting = f"{self.records:,} records ({self.bytes / 1e6:.0f} MB) wait"
        if self.idle_s > max(_LATE_S, 0.5 * self.behind_s):
            return f"the disk has taken no data for {self.idle_s:.0f} s; {waiting}"
        return f"the writer of the log is {self.behind_s:.1f} s behind; {waiting}, the disk takes data"


def max_queue_bytes() -> int:
    """Return the limit of the queue's memory [bytes]: 1 GiB, or a quarter of the machine's memory if that is less."""
    try:
        return min(_MAX_BYTES, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4)
    except (AttributeError, ValueError, OSError):  # not on every platform
        return _MAX_BYTES
