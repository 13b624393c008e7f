"""What each entry of an observation or an action is."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim2real.policy.contract import PolicyContract


@dataclass(frozen=True)
class Entry:
    """One number of an observation or an action.

    Attributes:
        name: Its name, e.g. ``past voltage[0][2]``: the term, how many steps ago, and the entry of that term.
        unit: Its unit; ``"1"`` stands for none.
        low: Lower bound [its unit]; infinite where none is known.
        high: Upper bound [its unit].
    """

    name: str
    unit: str
    low: float
    high: float


def entries_of(contract: PolicyContract) -> tuple[tuple[Entry, ...], tuple[Entry, ...]]:
    """Return the entries of a policy's observation, and those of its action."""
    known = [
        (unit, low, high)
        for term in contract.observation
        for _ in range(term.history)
        for unit, low, high in zip(
            term.units, term.low or (-math.inf,) * term.size, term.high or (math.inf,) * term.size, strict=True
        )
    ]
    seen = (Entry(name, *rest) for name, rest in zip(contract.observation_names, known, strict=True))
    return tuple(seen), tuple(Entry(term.name, term.unit, term.low, term.high) for term in contract.action)
