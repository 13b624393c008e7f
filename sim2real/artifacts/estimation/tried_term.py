"""An optional term that an identification tried, with its gain."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sim2real.artifacts.summary import ArtifactTable

Outcome = Literal["chosen", "mends", "no gain", "not reached", "not fitted"]


@dataclass(frozen=True)
class TriedTerm:
    """Errors on held-out parts without and with a term.

    Attributes:
        without: Root mean square without the term [deviations of a measurement].
        error: The same with the term; None if the set was not fitted, because less than 5 % of gain was predicted.
        outcome: ``chosen``; ``mends`` if the error falls by more than 5 %; ``not reached`` of a limit without effect.
    """

    term: str
    without: float
    error: float | None
    outcome: Outcome

    @property
    def gain(self) -> float | None:
        """By which share the term lowers the error."""
        return None if self.error is None or not self.without > 0.0 else 1.0 - self.error / self.without

    def __str__(self) -> str:
        """Return a few words, for a sentence."""
        if self.error is None or self.gain is None or self.outcome == "not reached":
            return f"{self.term} {self.outcome}"
        return f"{self.term} {self.without:.3g} to {self.error:.3g}"


def tried_table(rows: Sequence[TriedTerm]) -> ArtifactTable:
    """Return a row for each term."""
    cells = [
        [r.term, r.without, "" if r.error is None else r.error, "" if r.gain is None else f"{r.gain:.0%}", r.outcome]
        for r in rows
    ]
    return ArtifactTable(("term tried", "error without", "error with", "gain", "outcome"), cells)
