"""Which slots a boundary has, and in which of them each step is computed.

All rows share one sequence of slots, and each slot belongs to one node. The steps of a row must fit into it in an order
in which every step comes after those that it hears, and after its node's step before: a common supersequence of all
rows, as short as possible, as a slot is computed in every row whether or not a step stands in it. Pure numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim2real.errors import UsageError

STEPS = 256
"""Steps of one node at one boundary, at most."""

Steps = dict[str, np.ndarray]
"""Node -> a number for each of its steps, shape ``(E, N)``, int64."""


class Heard(NamedTuple):
    """The newest message that each step of ``reader`` has consumed from ``sender``, shape ``(E, N)``; -1: none."""

    reader: str
    sender: str
    newest: np.ndarray


class _Patterns(NamedTuple):
    """The P different rows that there are.

    Attributes:
        counts: Shape ``(P, n)``: how many steps of each node.
        needs: For each node, shape ``(P, M, n)``: how many steps of each node must come before its step m of the row.
        of_row: Shape ``(E * R,)``: the pattern of each row.
    """

    counts: np.ndarray
    needs: list[np.ndarray]
    of_row: np.ndarray


def arrange(
    supervisor: str, rows: int, row: Steps, counted: Steps, heard: Sequence[Heard]
) -> tuple[tuple[str, ...], Steps]:
    """Return the node of every slot of a boundary, and the slot of each step.

    The supervisor gets as many slots as it makes steps in its fullest row, and no more; the others as few as a greedy
    search finds.

    Args:
        supervisor: The node whose slots are the dearest.
        rows: How many rows there are.
        row: Row of each step; the order of the nodes decides where nothing else does.
        counted: Which steps are computed, shape ``(E, N)``, bool.
        heard: What steps wait for.

    Raises:
        UsageError: When a node makes too many steps in a row, or steps of a row wait for each other.
    """
    names = list(row)
    index = {n: _index_in_row(r) for n, r in row.items()}
    for n in names:
        if int(index[n][counted[n]].max(initial=0)) >= STEPS:
            raise UsageError(
                f"node {n!r} makes more than {STEPS} steps while the supervisor {supervisor!r} makes one",
                hint="bring the rates closer together",
            )
    patterns = _patterns(names, rows, row, index, counted, heard)
    sequence, slot_of = _merge(patterns, names, names.index(supervisor) if supervisor in names else -1)
    slots = {}
    for i, n in enumerate(names):
        e, k = np.nonzero(counted[n])
        slots[n] = np.zeros_like(row[n])
        slots[n][e, k] = slot_of[i][patterns.of_row[e * rows + row[n][e, k]], index[n][e, k]]
    return tuple(names[i] for i in sequence), slots


def _index_in_row(row: np.ndarray) -> np.ndarray:
    """Return how many steps of the same node come before each step in its row."""
    step = np.broadcast_to(np.arange(row.shape[1], dtype=np.int64), row.shape)
    opens = np.ones(row.shape, bool)
    opens[:, 1:] = row[:, 1:] != row[:, :-1]
    return step - np.maximum.accumulate(np.where(opens, step, 0), axis=1)


def _patterns(
    names: list[str], rows: int, row: Steps, index: Steps, counted: Steps, heard: Sequence[Heard]
) -> _Patterns:
    boundaries = rows * next((len(r) for r in row.values()), 0)
    counts = np.zeros((boundaries, len(names)), np.int16)
    at: dict[str, np.ndarray] = {}
    for i, n in enumerate(names):
        e, _ = np.nonzero(counted[n])
        at[n] = e * rows + row[n][counted[n]]
        counts[:, i] = np.bincount(at[n], minlength=boundaries)
    most = counts.max(axis=0, initial=0)
    needs = [np.zeros((boundaries, int(m), len(names)), np.int16) for m in most]
    for reader, sender, newest in heard:
        i, j = names.index(reader), names.index(sender)
        here = (newest >= 0) & (np.take_along_axis(row[sender], newest.clip(0), 1) == row[reader])
        before = np.where(here, np.take_along_axis(index[sender], newest.clip(0), 1) + 1, 0)[counted[reader]]
        places = (at[reader], index[reader][counted[reader]], j)
        needs[i][places] = np.maximum(needs[i][places], before)
    columns = np.concatenate([counts, *(n.reshape(boundaries, n.shape[1] * len(names)) for n in needs)], axis=1)
    first, of_row = _distinct(columns)
    return _Patterns(counts[first].astype(np.int64), [n[first].astype(np.int64) for n in needs], of_row)


def _distinct(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Do ``np.unique`` of rows: the first place of each different row, and which of them each row is.

    Columns are folded into one number a row: of 400,000 rows that takes 0.03 s, where ``axis=0`` takes 0.8 s.
    """
    label, size = np.zeros(len(columns), np.int64), 1
    for column in columns.T[columns.any(axis=0)]:
        span = int(column.max()) + 1
        if size * span >= 2**62:
            seen, label = np.unique(label, return_inverse=True)
            size = len(seen)
        label, size = label * span + column, size * span
    _, first, of_row = np.unique(label, return_index=True, return_inverse=True)
    return first, of_row


def _merge(patterns: _Patterns, names: list[str], supervisor: int) -> tuple[list[int], list[np.ndarray]]:
    """Return one sequence of nodes in which every pattern finds its steps, and the place of each step in it.

    Slots are added one by one, and every row takes one as soon as it can. The next one goes to a node of which every
    row with the most steps left has one ready: what must come gets shorter. Where there is none, a slot more than the
    fullest row needs is spent, on the node that most patterns have ready, but never on the supervisor: where a step of
    it has to wait, there is one that it waits for.

    Returns:
        The sequence; and for each node, shape ``(P, M)``, the slots of the steps of each pattern.
    """
    counts, needs = patterns.counts, patterns.needs
    every = np.arange(len(counts))
    placed = np.zeros_like(counts)
    slots = [np.zeros(n.shape[:2], np.int64) for n in needs]
    sequence: list[int] = []
    while (left := counts - placed).any():
        ready = np.zeros(counts.shape, bool)
        for i in np.flatnonzero(left.any(axis=0)):
            need = needs[i][every, np.minimum(placed[:, i], needs[i].shape[1] - 1)]
            ready[:, i] = (left[:, i] > 0) & (placed >= need).all(axis=1)
        fullest = (left == left.max(axis=0)) & (left > 0)
        shortens = ready.any(axis=0) & ~(fullest & ~ready).any(axis=0)
        if shortens.any():
            waiting = ((left > 0) & ~ready).sum(axis=0)
            i = int(np.argmin(np.where(shortens, waiting, len(counts) + 1)))
        else:
            found = ready.sum(axis=0)
            if supervisor >= 0:
                found[supervisor] = 0
            i = int(np.argmax(found))
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
