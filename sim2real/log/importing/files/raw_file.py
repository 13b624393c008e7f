"""What a reader of another recorder's file returns: names of signals, what loads one, and what it has to say."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class RawSignals:
    """The signals of a file.

    Attributes:
        keys: Names of the signals that a mapping is proposed from; ``load`` may know more.
        load: Returns a signal by name; raises KeyError if there is none.
        columns: Names of a signal's columns, where the file has some.
        notes: What was left out and why, and whose clock is used: sentences.
        nominal: Names of stamps that were generated from a rate, not recorded.
        facts: What the file says about itself.
    """

    keys: Sequence[str]
    load: Callable[[str], Any]
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    nominal: frozenset[str] = frozenset()
    facts: Mapping[str, Any] = field(default_factory=dict)
