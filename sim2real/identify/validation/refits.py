"""Finished refits without parts of the recordings, stored in a file, so that a judgement that was ended goes on there.

A refit is used again only for the same inputs: the file's digest covers logs, parameters and settings, and the model
must still give the loss that the fit of all parts had. Other data or another model gives another loss.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from sim2real.artifacts.files import read_json, write_json
from sim2real.artifacts.identification import TriedTerm
from sim2real.errors import Sim2RealError
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Data

REFITS = "refits.json"
_SAME = 3e-4
"""Relative difference of two losses up to which two fits ended in one minimum."""


@dataclass
class Stored:
    """The fit of a set of terms, and the estimates without parts.

    Attributes:
        z: The fit of all parts, ``(P,)``.
        ends: Part -> the estimate without it, ``(P,)``.
        tried: What further terms gain beside the set; empty: none was tried.
    """

    z: list[float]
    loss: float
    ends: dict[str, list[float]] = field(default_factory=dict)
    tried: list[TriedTerm] = field(default_factory=list)


@dataclass
class StoredRefits:
    """What the file holds: the digest of the inputs, and by set of terms the fits."""

    digest: str
    sets: dict[str, Stored] = field(default_factory=dict)


class Refits:
    """The finished refits of one identification; without a path they stay in memory.

    Attributes:
        reused: Number of refits that were used again.
        source: The file that they are from; None: there is none of the same inputs.
        stored: Whether the file was written.
    """

    def __init__(self, path: Path | None = None, digest: str = "", earlier: Iterable[Path] = ()) -> None:
        self._path, self._document, self.reused = path, StoredRefits(digest), 0
        self.source: Path | None = None
        self.stored = False
        self._lock = threading.Lock()
        for file in earlier:
            try:
                document = read_json(file, StoredRefits)
            except (Sim2RealError, ValueError, OSError, msgspec.MsgspecError):
                continue  # an unreadable file costs time only: the refits are computed
            if document.digest == digest and document.sets:
                self._document, self.source = document, file
                return

    def whole(self, terms: Sequence[str], problem: Problem, data: Data) -> tuple[np.ndarray, float] | None:
        """Return a stored fit of all parts and its loss; None if there is none, or the problem gives another loss."""
        stored = self._document.sets.get(_key(terms))
        if stored is None or not self._has_loss(np.array(stored.z), stored.loss, problem, data):
            self._document.sets.pop(_key(terms), None)
            return None
        return np.array(stored.z), stored.loss

    def begin(self, terms: Sequence[str], z: np.ndarray, loss: float) -> None:
        """Store the fit of all parts. Estimates without parts stay if they were made for the same minimum."""
        stored = self._document.sets.get(_key(terms))
        if stored is None or not abs(loss - stored.loss) <= _SAME * abs(stored.loss):
            self._document.sets[_key(terms)] = Stored(z.tolist(), loss)
            self._write()

    def end(self, terms: Sequence[str], part: str) -> np.ndarray | None:
        """Return the stored estimate without a part; None: it was not computed."""
        stored = self._document.sets.get(_key(terms))
        if stored is None or part not in stored.ends:
            return None
        self.reused += 1
        return np.array(stored.ends[part])

    def store(self, terms: Sequence[str], part: str, z: np.ndarray) -> np.ndarray:
        """Store the estimate without a part, and return it."""
        self._document.sets[_key(terms)].ends[part] = z.tolist()
        self._write()
        return z

    def tried(self, terms: Sequence[str], compute: Callable[[], Sequence[TriedTerm]]) -> tuple[TriedTerm, ...]:
        """Return what further terms gain beside a set whose fit is stored; it is computed once."""
        stored = self._document.sets[_key(terms)]
        if not stored.tried:
            stored.tried = list(compute())
            self._write()
        return tuple(stored.tried)

    def _has_loss(self, z: np.ndarray, loss: float, problem: Problem, data: Data) -> bool:
        if len(z) != len(problem.table):
            return False
        return abs(problem.loss(z, data) - loss) <= _SAME * abs(loss)

    def close(self) -> None:
        """Stop writing: a thread that still computes must not change a file of a stage that has ended."""
        with self._lock:
            self._path = None

    def _write(self) -> None:
        with self._lock:
            if self._path is not None:
                self.stored = True
                write_json(self._path, self._document)


def _key(terms: Sequence[str]) -> str:
    return ",".join(terms)
