"""How old the messages were that a node's steps used, from what a log says of every message."""

from __future__ import annotations

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S


def input_ages(episode: Episode, node: str) -> dict[str, np.ndarray]:
    """Return how long before each step's start the newest message that it used was sent, by input.

    What a hiccup leaves behind shows here: steps may be punctual and yet use old messages.

    Args:
        episode: A log.
        node: The reader.

    Returns:
        Input -> ages ``(N,)`` [s]; NaN before the first message. No inputs where steps are missing between those that
        the log holds: which step used what cannot be told then.
    """
    log = episode.metadata.get("log", {})
    if log.get("missing_steps", {}).get(node):
        return {}
    first, start = int(log.get("first_seq", {}).get(node, 0)), episode.steps[node].start
    ages = {}
    for (reader, name), messages in episode.messages.items():
        if reader != node:
            continue
        row = messages.seq_in - first
        used = (messages.seq_in >= 0) & (row >= 0) & (row < len(start))
        newest = np.full(len(start), -np.inf)
        np.maximum.at(newest, row[used], messages.sent[used])
        newest = np.maximum.accumulate(newest)  # a step without a new message goes on with the one before
        ages[name] = np.where(np.isfinite(newest), (start - newest) / TICKS_PER_S, np.nan)
    return ages


def oldest_input(episode: Episode, node: str) -> np.ndarray:
    """Return the age of each step's oldest input ``(M,)`` [s], of those steps that had a message at every input."""
    ages = list(input_ages(episode, node).values())
    if not ages:
        return np.zeros(0)
    oldest = np.max(ages, axis=0)
    return oldest[np.isfinite(oldest)]
