"""Searches for faults: suspects change a setting, and the ones that explain most of an error are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

_MOST, _HEADS, _SWEEPS = 4, 6, 4


@dataclass(frozen=True)
class Finding:
    """A fault.

    Attributes:
        fault: Name of the fault, such as ``joint order``.
        question: ``contract``, ``timing`` or ``plant``.
        text: One sentence.
        share: Share of the gap that it explains, from 0 to 1.
        numbers: Name -> value.
    """

    fault: str
    question: str
    text: str
    share: float
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Setting:
    """The differences of a deployment from its contract or model: name -> value."""

    values: tuple[tuple[str, Any], ...] = ()

    def get(self, name: str, usual: Any = 1.0) -> Any:
        """Return the value of a name; ``usual`` if the setting has none."""
        return dict(self.values).get(name, usual)

    def with_values(self, values: Mapping[str, Any]) -> Setting:
        """Return the setting with other values for some names."""
        return Setting(tuple(sorted((dict(self.values) | dict(values)).items())))

    def __contains__(self, name: str) -> bool:
        return name in dict(self.values)


Move = Callable[[Setting], Iterable[Setting]]


@dataclass(frozen=True)
class Candidate:
    """A setting with one more fault than the known ones.

    Attributes:
        text: Returns the sentence about a setting.
        moves: Functions that return settings near a given one.
        least: Smallest share by which it must lower the error.
    """

    fault: str
    setting: Setting
    text: Callable[[Setting], str]
    moves: Sequence[Move] = ()
    least: float = 0.12

    def descended(self, error: Callable[[Setting], float]) -> Candidate:
        """Return the candidate with the best setting nearby, after trying its moves in turn."""
        best = self.setting
        for _ in range(_SWEEPS):
            before = best
            for move in self.moves:
                best = min((best, *move(best)), key=error)
            if best == before:
                break
        return replace(self, setting=best)


@dataclass(frozen=True)
class Suspect:
    """A possible fault: names of a setting, all of which get the same value.

    Attributes:
        text: A sentence with ``value`` and ``ms``, or a function of the value.
        grid: The values that are tried first.
        near: Returns values near a given value.
        least: As in ``Candidate``.
    """

    fault: str
    names: tuple[str, ...]
    text: str | Callable[[Any], str]
    grid: Sequence[Any]
    near: Callable[[Any], Iterable[Any]] = lambda _: ()
    least: float = 0.12

    def move(self, at: Setting) -> Iterable[Setting]:
        """Return settings near a given one."""
        value = at.get(self.names[0], self.grid[0])
        return [at.with_values(dict.fromkeys(self.names, v)) for v in self.near(value)]

    def candidates(self, start: Setting, *more: Move) -> list[Candidate]:
        """Return a candidate for each value of the grid; ``more``: further moves."""
        moves = (self.move, *more)
        return [Candidate(self.fault, start.with_values(dict.fromkeys(self.names, v)), self.says, moves, self.least)
                for v in self.grid]  # fmt: skip

    def says(self, at: Setting) -> str:
        """Return the sentence about a setting."""
        value = at.get(self.names[0])
        return self.text(value) if callable(self.text) else self.text.format(value=value, ms=_milli(value))


def _milli(value: Any) -> float:
    return 1e3 * value if isinstance(value, float) else 0.0


def explain(
    start: Setting,
    error: Callable[[Setting], float],
    candidates: Callable[[Setting], Iterable[Candidate]],
    sound: float,
    dear: bool = False,
) -> list[Candidate]:
    """Return the candidates that explain an error, the most important first; each setting includes those before it.

    Args:
        error: Returns the error of a setting; caches its results.
        candidates: Returns further possible faults of a setting.
        sound: Error below which there is no fault.
        dear: Whether ``error`` takes long: then fewer candidates are tried, and faults that show only together are
            missed.
    """

    def ranked(setting: Setting) -> list[Candidate]:
        """Return the candidates, the best first; the best of all, and the best of each fault, are refined."""
        found = sorted(candidates(setting), key=lambda c: error(c.setting))
        of_faults = list({c.fault: i for i, c in reversed(list(enumerate(found)))}.values())
        for i in {*range(min(0 if dear else 3, len(found))), *sorted(of_faults)[: 3 if dear else _HEADS]}:
            found[i] = found[i].descended(error)
        return sorted(found, key=lambda c: error(c.setting))

    chosen: list[Candidate] = []
    while (before := error(start)) > sound and len(chosen) < _MOST:
        found = ranked(start)
        clear = [c for c in found if before - error(c.setting) >= max(c.least * before, 0.4 * sound)]
        if clear:
            chosen.append(clear[0])
        else:
            heads = {c.fault: c for c in reversed(found)} if not dear else {}
            firsts = sorted(heads.values(), key=lambda c: error(c.setting))[:_HEADS]
            both = [(first, second[0]) for first in firsts if (second := ranked(first.setting))]
            best = min(both, key=lambda pair: error(pair[1].setting), default=None)
            if best is None or error(best[1].setting) > 0.6 * before:
                break
            chosen += best
        start = chosen[-1].setting
    return chosen


def shortened(parts: Sequence[str]) -> str:
    """Return the first two of many parts of a sentence, and the number of the others."""
    return ", ".join(parts[:2]) + (f" and {len(parts) - 2} more" if len(parts) > 2 else "")
