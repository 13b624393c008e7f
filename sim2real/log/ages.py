"""The age of the messages that a node's steps use, computed from a log."""

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S


def input_ages(episode: Episode, node: str) -> dict[str, np.ndarray]:
    """Return the time from the sending of the newest used message to each step's start, by input.

    Ages show hiccups that step times do not show: punctual steps that use old messages.

    Returns:
        Input -> ages ``(N,)`` [s]; NaN before the first message. Empty if the log lacks steps, as the step of a message
        is then unknown.
    """
    log = episode.metadata.get("log", {})
    if log.get("missing_steps", {}).get(node):
        return {}
    first, start = int(log.get("first_seq", {}).get(node, 0)), episode.steps[node].start
    ages = {}
    for (reader, name), messages in episode.messages.items():
        if reader != node:
            continue
        # Find the newest message of each step; a step without a new message uses the previous one.
        row = messages.seq_in - first
        used = (messages.seq_in >= 0) & (row >= 0) & (row < len(start))
        newest = np.full(len(start), -np.inf)
        np.maximum.at(newest, row[used], messages.sent[used])
        newest = np.maximum.accumulate(newest)  # a step without a new message uses the previous one again
        ages[name] = np.where(np.isfinite(newest), (start - newest) / TICKS_PER_S, np.nan)
    return ages


def oldest_input(episode: Episode, node: str) -> np.ndarray:
    """Return the largest age among each step's inputs, ``(M,)`` [s], for steps that had a message on every input."""
    ages = list(input_ages(episode, node).values())
    if not ages:
        return np.zeros(0)
    oldest = np.max(ages, axis=0)
    return oldest[np.isfinite(oldest)]
