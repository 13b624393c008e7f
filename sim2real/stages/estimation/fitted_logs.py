"""Logs that were fitted are no test of a fit: they are found by their files' hashes and by what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.manifest import sha256
from sim2real.errors import UsageError
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.validation.prediction import position_of
from sim2real.stages.terminal.console import note

_PIECE = 50
"""Samples of motion that are in two logs only if both hold the same stretch."""
_SAME = 1e-5
"""Share of the range of a piece that its numbers may be off, by rounding alone."""


def require_new(found: Identification, logs: Sequence[Recording], model: IdentifiableModel, force: bool) -> list[str]:
    """Check that logs are none that parameters were identified from.

    A copy, an import of the same file, and a part that was cut out of a fitted log are found by their measurements.

    Args:
        model: The robot's, for what it measures.
        force: Whether such logs are named and used all the same.

    Returns:
        The names of those that were fitted.

    Raises:
        UsageError: One of them was fitted.
    """
    rows = found.samples
    fitted = set(rows["recording"][~rows["held_out"]].tolist()) if rows else set(range(len(found.logs)))
    known = {source.sha256: source.path for i, source in enumerate(found.logs) if i in fitted}
    pieces = list(_fitted_pieces(found, model))
    again = []
    for log in logs:
        read = _measured(log, model)
        if (path := known.get(_hash(log) or "")) is not None:
            again.append(f"{log.path} is {path}, which these parameters were identified from")
        elif any(_contains(read, piece) for piece in pieces):
            again.append(f"{log.path} holds measurements that these parameters were identified from")
    return _refuse(again, "take a log of later motion, or --force: errors there are no test of a fit", force)


def require_apart(
    fitted: Sequence[Recording], held_out: Sequence[Recording], model: IdentifiableModel, force: bool
) -> None:
    """Check that no log is given twice: to be fitted and held out, or to be fitted two times.

    Args:
        model: The robot's, for what it measures.
        force: Whether such logs are named and used all the same.

    Raises:
        UsageError: One is.
    """
    hashes = [_hash(log) for log in fitted]
    twice = [
        f"{a.path} and {b.path} are the same log: fitted twice, it would count twice"
        for (a, ha), (b, hb) in combinations(zip(fitted, hashes, strict=True), 2)
        if ha is not None and ha == hb
    ]
    for log in held_out:
        own, read = _hash(log), _measured(log, model)
        for other, known in zip(fitted, hashes, strict=True):
            if (own is not None and own == known) or any(_contains(_measured(other, model), p) for p in _cut(read)):
                twice.append(f"{log.path} is to be held out, and {other.path}, with the same measurements, fitted")
    _refuse(twice, "name each log once, or --force: held-out errors of a fitted log are no test of the fit", force)


def _refuse(said: list[str], hint: str, force: bool) -> list[str]:
    if said and not force:
        raise UsageError("; ".join(said), hint=hint)
    for sentence in said:
        note(f"warning: {sentence}")
    return said


def _hash(log: Recording) -> str | None:
    """Return the SHA-256 of a log's file; None where there is no such file."""
    return sha256(log.path) if log.path.is_file() else None


def _measured(log: Recording, model: IdentifiableModel) -> np.ndarray:
    """Return all positions that a log measured, ``(N, C)``."""
    read = log.episode.outputs.get(model.sensor, {})
    columns = [np.asarray(c.of(read[c.position]), np.float64) for c in model.channels if c.position in read]
    return np.stack(columns, axis=1) if columns else np.zeros((0, 0))


def _fitted_pieces(found: Identification, model: IdentifiableModel) -> Iterator[np.ndarray]:
    """Return what was measured in segments that were fitted, pieces ``(n, C)``."""
    rows, names = found.samples, [f"{position_of(c)}_measured" for c in model.channels]
    if not rows or any(name not in rows for name in names):
        return
    read, fitted = np.stack([rows[name] for name in names], axis=1).astype(np.float64), ~rows["held_out"].astype(bool)
    for segment in np.unique(rows["segment"][fitted]):
        yield from _cut(read[rows["segment"] == segment])


def _cut(read: np.ndarray) -> Iterator[np.ndarray]:
    """Return pieces of measurements in which something moves; shorter measurements are one piece."""
    for first in range(0, max(len(read) - _PIECE, 0) + 1, _PIECE):
        piece = read[first : first + _PIECE]
        if len(piece) > 1 and max(len(np.unique(column)) for column in piece.T) > len(piece) // 4:
            yield piece


def _contains(read: np.ndarray, piece: np.ndarray) -> bool:
    """Return whether rows ``(N, C)`` hold a piece ``(n, C)``, one row after the other."""
    size = len(piece)
    if len(read) < size or read.shape[1:] != piece.shape[1:]:
        return False
    slack = _SAME * np.ptp(piece, axis=0).max()
    # The ends first: few places have them.
    ends = [
        np.abs(read[i : len(read) - size + 1 + i] - piece[i]).max(axis=1) <= slack for i in (0, size // 2, size - 1)
    ]
    return any(np.abs(read[i : i + size] - piece).max() <= slack for i in np.flatnonzero(np.all(ends, axis=0)))
