"""The sequence of slots that all rows share, and the slot of each step.

Each slot belongs to one node. The steps of every row must fit into the sequence such that each step comes after the
steps whose messages it consumes, and after its node's previous step. The sequence should be short, because every row
computes every slot, with or without a step in it: this is a shortest common supersequence problem. Pure numpy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim2real.errors import UsageError

STEPS = 256
"""Largest number of steps of one node in a row."""

Steps = dict[str, np.ndarray]
"""Node name -> an int64 for each of its steps, shape ``(E, N)``."""


class Heard(NamedTuple):
    """The newest message that each step of ``reader`` has consumed from ``sender``, shape ``(E, N)``; -1: none."""

    reader: str
    sender: str
    newest: np.ndarray


class _Patterns(NamedTuple):
    """The P distinct patterns of steps in a row; rows with the same pattern are treated together.

    Attributes:
        counts: Shape ``(P, n)``: number of steps of each of the n nodes.
        needs: For each node, shape ``(P, M, n)``: how many steps of each node come before its m-th step in the row.
        of_row: Shape ``(E * R,)``: the pattern of each row.
    """

    counts: np.ndarray
    needs: list[np.ndarray]
    of_row: np.ndarray


def arrange(
    supervisor: str, rows: int, row: Steps, counted: Steps, heard: Sequence[Heard]
) -> tuple[tuple[str, ...], Steps]:
    """Return the node of each slot, and the slot of each step.

    The supervisor gets as many slots as it has steps in its fullest row, never more. The number of the other nodes'
    slots is kept small by a greedy search.

    Args:
        row: Row of each step. Ties are decided by the order of the nodes in this dictionary.
        counted: Node -> mask of its computed steps, shape ``(E, N)``, bool.
    """
    names = list(row)
    index = {n: _index_in_row(r) for n, r in row.items()}
    for n in names:
        if int(index[n][counted[n]].max(initial=0)) >= STEPS:
            raise UsageError(
                f"node {n!r} makes more than {STEPS} steps while the supervisor {supervisor!r} makes one",
                hint="bring the rates closer together",
            )
    # Merge the patterns of all rows into one sequence of slots.
    patterns = _patterns(names, rows, row, index, counted, heard)
    sequence, slot_of = _merge(patterns, names, names.index(supervisor) if supervisor in names else -1)
    # Give each step the slot of its pattern.
    slots = {}
    for i, n in enumerate(names):
        e, k = np.nonzero(counted[n])
        slots[n] = np.zeros_like(row[n])
        slots[n][e, k] = slot_of[i][patterns.of_row[e * rows + row[n][e, k]], index[n][e, k]]
    return tuple(names[i] for i in sequence), slots


def _index_in_row(row: np.ndarray) -> np.ndarray:
    """Return for each step the number of the same node's steps before it in its row."""
    step = np.broadcast_to(np.arange(row.shape[1], dtype=np.int64), row.shape)
    opens = np.ones(row.shape, bool)
    opens[:, 1:] = row[:, 1:] != row[:, :-1]
    return step - np.maximum.accumulate(np.where(opens, step, 0), axis=1)


def _patterns(
    names: list[str], rows: int, row: Steps, index: Steps, counted: Steps, heard: Sequence[Heard]
) -> _Patterns:
    # Count the steps of each node in each row.
    boundaries = rows * next((len(r) for r in row.values()), 0)
    counts = np.zeros((boundaries, len(names)), np.int16)
    at: dict[str, np.ndarray] = {}
    for i, n in enumerate(names):
        e, _ = np.nonzero(counted[n])
        at[n] = e * rows + row[n][counted[n]]
        counts[:, i] = np.bincount(at[n], minlength=boundaries)
    # For each step, the senders' steps of this row that come before it.
    most = counts.max(axis=0, initial=0)
    needs = [np.zeros((boundaries, int(m), len(names)), np.int16) for m in most]
    for reader, sender, newest in heard:
        i, j = names.index(reader), names.index(sender)
        here = (newest >= 0) & (np.take_along_axis(row[sender], newest.clip(0), 1) == row[reader])
        before = np.where(here, np.take_along_axis(index[sender], newest.clip(0), 1) + 1, 0)[counted[reader]]
        places = (at[reader], index[reader][counted[reader]], j)
        needs[i][places] = np.maximum(needs[i][places], before)
    # Rows with equal numbers share a pattern.
    columns = np.concatenate([counts, *(n.reshape(boundaries, n.shape[1] * len(names)) for n in needs)], axis=1)
    first, of_row = _distinct(columns)
    return _Patterns(counts[first].astype(np.int64), [n[first].astype(np.int64) for n in needs], of_row)


def _distinct(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index of each distinct row, and for each row its distinct row, as ``np.unique(axis=0)`` does.

    The columns are first combined into one integer per row: 0.03 s for 400,000 rows, against 0.8 s for ``axis=0``.
    """
    label, size = np.zeros(len(columns), np.int64), 1
    for column in columns.T[columns.any(axis=0)]:
        span = int(column.max()) + 1
        if size * span >= 2**62:
            labels, label = np.unique(label, return_inverse=True)
            size = len(labels)
        label, size = label * span + column, size * span
    _, first, of_row = np.unique(label, return_index=True, return_inverse=True)
    return first, of_row


def _merge(patterns: _Patterns, names: list[str], supervisor: int) -> tuple[list[int], list[np.ndarray]]:
    """Find one sequence of nodes that contains the steps of every pattern in a valid order (greedy search).

    Slots are added one by one; every pattern with a ready step of that node puts the step there.

    Returns:
        The sequence; and for each node, shape ``(P, M)``, the slots of the steps of each pattern.
    """
    counts, needs = patterns.counts, patterns.needs
    every = np.arange(len(counts))
    placed = np.zeros_like(counts)
    slots = [np.zeros(n.shape[:2], np.int64) for n in needs]
    sequence: list[int] = []
    while (left := counts - placed).any():
        # A step is ready if the steps that it needs are placed.
        ready = np.zeros(counts.shape, bool)
        for i in np.flatnonzero(left.any(axis=0)):
            need = needs[i][every, np.minimum(placed[:, i], needs[i].shape[1] - 1)]
            ready[:, i] = (left[:, i] > 0) & (placed >= need).all(axis=1)

        # Prefer a node whose step is ready in all the patterns that have the most steps of it left: such a slot is
        # needed in any case. Otherwise add an extra slot for the node whose step is ready in most patterns. It never
        # goes to the supervisor: a step of it that is not ready waits for another node's step, which comes first.
        fullest = (left == left.max(axis=0)) & (left > 0)
        shortens = ready.any(axis=0) & ~(fullest & ~ready).any(axis=0)
        if shortens.any():
            waiting = ((left > 0) & ~ready).sum(axis=0)
            i = int(np.argmin(np.where(shortens, waiting, len(counts) + 1)))
        else:
            patterns_ready = ready.sum(axis=0)
            if supervisor >= 0:
                patterns_ready[supervisor] = 0
            i = int(np.argmax(patterns_ready))

        # Place the step in all patterns in which it is ready.
        now = np.flatnonzero(ready[:, i])
        if not len(now):
            stuck = [names[j] for j in np.flatnonzero(left.any(axis=0))]
            raise UsageError(
                f"steps of {', '.join(stuck)} wait for each other's messages of the same instant",
                hint="give the nodes of a loop a computation delay",
            )
        slots[i][now, placed[now, i]] = len(sequence)
        placed[now, i] += 1
        sequence.append(i)
    return sequence, slots
