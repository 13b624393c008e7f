"""The signals that a reader of another recorder's file returns: names, a loader, and notes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from sim2real.types import Json


@dataclass(frozen=True)
class RawSignals:
    """The signals of a file.

    Attributes:
        keys: Names of the signals that a proposal uses; ``load`` can accept more names.
        load: Returns a signal by name; raises KeyError for an unknown name.
        columns: Signal -> names of its columns.
        notes: Sentences about skipped signals and the chosen clock.
        nominal: Names of stamps that were generated from a rate, not recorded.
        facts: Metadata of the file.
    """

    keys: Sequence[str]
    load: Callable[[str], Json]
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    nominal: frozenset[str] = frozenset()
    facts: Mapping[str, Json] = field(default_factory=dict)
