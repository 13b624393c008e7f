"""Logs beside those of a fit: a fitted log is no test, by hashes and measurements; a log of standing has the load."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.manifest import sha256
from sim2real.errors import OtherMotion, UsageError
from sim2real.identify.model import IdentifiableModel, position_of
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.terminal.console import note

_PIECE = 50
"""Samples in a piece of motion; two logs that hold the same piece hold the same recording."""
_SAME = 1e-5
"""Largest difference by rounding, as a share of the range of a piece."""


def require_new(
    identification: Identification, logs: Sequence[Recording], model: IdentifiableModel, force: bool
) -> list[str]:
    """Return the names of logs that the parameters were identified from; by default such a log is an error.

    A copy, an import of the same file and a part of a fitted log have the same measurements.

    Args:
        force: Whether to warn, and use such logs.

    Raises:
        UsageError: A log was fitted, and ``force`` is False.
    """
    # Collect the hashes and the measurements of the fitted logs.
    rows = identification.samples
    fitted = set(rows["recording"][~rows["held_out"]].tolist()) if rows else set(range(len(identification.logs)))
    paths = {s.sha256: s.path for i, s in enumerate(identification.logs) if i in fitted and s.sha256}
    pieces = list(_fitted_pieces(identification, model))
    # Compare each log with them.
    messages = []
    for log in logs:
        positions = _measured(log, model)
        if (path := paths.get(hash_of(log))) is not None:
            messages.append(f"{log.path} is {path}, which these parameters were identified from")
        elif any(_contains(positions, piece) for piece in pieces):
            messages.append(f"{log.path} holds measurements that these parameters were identified from")
    return _refuse(messages, "take a log of later motion: errors there are no test of a fit", force)


def require_standing(robot: RecordedRobot, log: Recording, model: IdentifiableModel) -> None:
    """Refuse a log that is not of a robot on its feet."""
    from sim2real.robots.walking.plain import weighing  # the modules of walking robots alone

    weighing.check(robot, log.episode, {p.name: p.nominal for p in model.parameters})


def with_load(
    identification: Identification, robot: RecordedRobot, log: Recording, truth: Mapping[str, float]
) -> Identification:
    """Return an identification with the load, from a log of the robot on its feet; see ``weighing.weighed``.

    A load outside of its bounds is a warning: the rest is identified.
    """
    from sim2real.robots.walking.plain import weighing

    try:
        return weighing.weighed(robot, identification, log.episode, truth)
    except OtherMotion as error:
        note(f"warning: the load is not identified: {error}")
        return identification


def require_apart(
    fitted: Sequence[Recording], held_out: Sequence[Recording], model: IdentifiableModel, force: bool
) -> None:
    """Raise an error if a log is given twice: fitted and held out, or fitted two times.

    Args:
        force: Whether to warn, and use such logs.

    Raises:
        UsageError: A log is given twice, and ``force`` is False.
    """
    hashes = [hash_of(log) for log in fitted]
    messages = [
        f"{a.path} and {b.path} are the same log: fitted twice, it would count twice"
        for (a, ha), (b, hb) in combinations(zip(fitted, hashes, strict=True), 2)
        if ha and ha == hb
    ]
    positions = [_measured(log, model) for log in fitted]
    for log in held_out:
        digest, pieces = hash_of(log), list(_cut(_measured(log, model)))
        for other, other_digest, whole in zip(fitted, hashes, positions, strict=True):
            if (digest and digest == other_digest) or any(_contains(whole, p) for p in pieces):
                messages.append(f"{log.path} is to be held out, and {other.path}, with the same measurements, fitted")
    _refuse(messages, "name each log once: held-out errors of a fitted log are no test of the fit", force)


def _refuse(messages: list[str], hint: str, force: bool) -> list[str]:
    if messages and not force:
        raise UsageError("; ".join(messages), hint=f"{hint}; --force (in Python {{'force': True}}) uses it anyway")
    for sentence in messages:
        note(f"warning: {sentence}")
    return messages


def hash_of(log: Recording) -> str:
    """Return the SHA-256 of a log's file; "" if there is no such file."""
    return sha256(log.path) if log.path.is_file() else ""


def _measured(log: Recording, model: IdentifiableModel) -> np.ndarray:
    """Return all measured positions of a log, ``(N, C)``."""
    read = log.episode.outputs.get(model.sensor, {})
    columns = [np.asarray(c.of(read[c.position]), np.float64) for c in model.channels if c.position in read]
    return np.stack(columns, axis=1) if columns else np.zeros((0, 0))


def _fitted_pieces(identification: Identification, model: IdentifiableModel) -> Iterator[np.ndarray]:
    """Yield the measurements of fitted segments, in pieces ``(n, C)``."""
    rows, names = identification.samples, [f"{position_of(c)}_measured" for c in model.channels]
    if not rows or any(name not in rows for name in names):
        return
    read, fitted = np.stack([rows[name] for name in names], axis=1).astype(np.float64), ~rows["held_out"].astype(bool)
    for segment in np.unique(rows["segment"][fitted]):
        yield from _cut(read[rows["segment"] == segment])


def _cut(read: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pieces of measurements with motion; measurements shorter than a piece are one piece."""
    for first in range(0, max(len(read) - _PIECE, 0) + 1, _PIECE):
        piece = read[first : first + _PIECE]
        if len(piece) > 1 and max(len(np.unique(column)) for column in piece.T) > len(piece) // 4:
            yield piece


def _contains(read: np.ndarray, piece: np.ndarray) -> bool:
    """Return whether measurements ``(N, C)`` contain a piece ``(n, C)``."""
    size = len(piece)
    if len(read) < size or read.shape[1:] != piece.shape[1:]:
        return False
    slack = _SAME * np.ptp(piece, axis=0).max()
    # Compare the ends and the middle first: few places match there.
    ends = [
        np.abs(read[i : len(read) - size + 1 + i] - piece[i]).max(axis=1) <= slack for i in (0, size // 2, size - 1)
    ]
    return any(np.abs(read[i : i + size] - piece).max() <= slack for i in np.flatnonzero(np.all(ends, axis=0)))
