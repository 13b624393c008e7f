"""The printed form of an import: notes on a file, the proposed mapping with its evidence, and the written files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.stages.terminal.console import note, pairs, shown, wrote
from sim2real.types import Json


def show_notes(file: ForeignFile) -> None:
    """Print the notes of a file's reader."""
    for line in file.notes:
        note(line)


def show_proposal(file: ForeignFile, evidence: Sequence[str]) -> None:
    """Print the evidence for a proposed mapping."""
    note(f"proposed mapping for {file.path.name}:")
    for line in evidence:
        note(f"  {line}")


def show_log(facts: Mapping[str, Json], log: Path, mapping: Path | None) -> None:
    """Print the figures and the path of a written log.

    Args:
        mapping: File of the proposed mapping; None if none was written.
    """
    print(pairs(facts))
    wrote(log)
    if mapping is not None:
        wrote(mapping)
        note(f"the next file of this recorder: sim2real import FILE --mapping {shown(mapping)}")
