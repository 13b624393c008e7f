"""The times of steps and messages of E episodes, in ticks [us]: the parts of a timeline."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

NEVER = np.int64(2**60)
"""Time of a step or a message that does not exist [ticks]."""


@dataclass(frozen=True)
class Vertex:
    """The steps of one node; times in ticks [us] from the episode's start.

    Attributes:
        start: Shape ``(E, N)``, int64. Entries after an episode's last step are padding and do not decrease.
        end: Shape ``(E, N)``, int64.
        count: Shape ``(E,)``: each episode's number of steps.
    """

    start: np.ndarray
    end: np.ndarray
    count: np.ndarray


@dataclass(frozen=True)
class Edge:
    """The messages of one connection.

    Attributes:
        received: Shape ``(E, M)``, int64: arrivals [ticks]. Message m is the output of the sender's step m, sent at
            the end of that step.
        seq_in: Shape ``(E, M)``, int64: number of the reader's step that consumed it; -1 if none did.
    """

    received: np.ndarray
    seq_in: np.ndarray
    sender: str


def search_rows(rows: np.ndarray, values: np.ndarray, side: Literal["left", "right"] = "left") -> np.ndarray:
    """Apply ``np.searchsorted`` to every row.

    Args:
        rows: Shape ``(E, N)``, int64, not decreasing along the last axis.
        values: Shape ``(E, M)``, int64; all times around ``NEVER`` count as equal.

    Returns:
        Shape ``(E, M)``: index of each value in its row.
    """
    # Rows are searched as one sorted array, each lifted above the one before. NEVER is replaced by a time just above
    # all others, so that the lifted values fit into 64 bits.
    low = min(int(rows.min(initial=0)), int(values.min(initial=0)))
    real = [a[a < NEVER // 2] for a in (rows, values)]
    high = max(int(a.max(initial=0)) for a in real) + 2
    lift = (np.arange(len(rows), dtype=np.int64) * (high - low + 1))[:, None]
    flat = np.searchsorted(
        (np.minimum(rows, high) + lift).ravel(), (np.minimum(values, high) + lift).ravel(), side=side
    )
    return flat.reshape(values.shape) - np.arange(len(rows))[:, None] * rows.shape[1]
