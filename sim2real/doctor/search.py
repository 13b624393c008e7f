"""The search for what is wrong: candidates change a setting, and those stay that explain most of an error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Self, TypeVar

_MOST, _HEADS, _SWEEPS = 4, 6, 4


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        fault: Its name, such as ``joint order``.
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
    """What a deployment is like; ``numbers``: name -> value, of those that differ from what was agreed."""

    numbers: tuple[tuple[str, float], ...] = ()

    def number(self, name: str, usual: float = 1.0) -> float:
        """Return the value of a name."""
        return dict(self.numbers).get(name, usual)

    def having(self, name: str, value: float) -> Self:
        """Return the setting with another value of a name."""
        return replace(self, numbers=tuple(sorted((dict(self.numbers) | {name: value}).items())))


S = TypeVar("S", bound=Setting)


@dataclass(frozen=True)
class Candidate(Generic[S]):
    """One thing that may be wrong.

    Attributes:
        setting: What a deployment with it is like.
        text: Returns the sentence about a setting.
        moves: Each returns settings near one, which differ in one way.
        least: Share of the error by which it must lower it.
    """

    fault: str
    setting: S
    text: Callable[[S], str]
    moves: Sequence[Callable[[S], Iterable[S]]] = ()
    least: float = 0.12

    def descended(self, error: Callable[[S], float]) -> Candidate[S]:
        """Return the candidate with the best setting near its own, one way after the other."""
        best = self.setting
        for _ in range(_SWEEPS):
            before = best
            for move in self.moves:
                best = min((best, *move(best)), key=error)
            if best == before:
                break
        return replace(self, setting=best)


@dataclass(frozen=True)
class Dial:
    """A number that may be wrong.

    Attributes:
        text: A sentence with ``name``, ``value`` and ``ms``.
        grid: The values that are tried first.
        near: Returns those near a value.
        least: As of a candidate.
    """

    fault: str
    text: str
    grid: Sequence[float]
    near: Callable[[float], Iterable[float]] = lambda _: ()
    least: float = 0.12

    def move(self, name: str) -> Callable[[S], Iterable[S]]:
        """Return what gives settings near one."""
        return lambda at: [at.having(name, float(v)) for v in self.near(at.number(name, self.grid[0]))]

    def candidates(self, setting: S, name: str, more: Sequence[Callable[[S], Iterable[S]]] = ()) -> list[Candidate[S]]:
        """Return a candidate for each value of the grid; ``more``: further moves."""
        moves = [self.move(name), *more]
        return [Candidate(self.fault, setting.having(name, float(v)), self.says(name), moves, self.least)
                for v in self.grid]  # fmt: skip

    def says(self, name: str) -> Callable[[Setting], str]:
        """Return what gives the sentence about a setting."""
        return lambda at: self.text.format(name=name, value=at.number(name), ms=1e3 * at.number(name))


def explain(
    start: S,
    error: Callable[[S], float],
    candidates: Callable[[S], Iterable[Candidate[S]]],
    sound: float,
    dear: bool = False,
) -> list[Candidate[S]]:
    """Return the candidates that explain an error, the greatest first; each setting has those before it.

    Args:
        error: Error of a setting; it keeps what it has computed.
        candidates: Returns what may be wrong beside what a setting has already.
        sound: Error below which nothing is wrong.
        dear: Whether an error takes long: fewer candidates are followed, and two that explain only together are missed.
    """

    def ranked(setting: S) -> list[Candidate[S]]:
        """Return the candidates in their order; the best of all and of each fault have the best setting near theirs."""
        found = sorted(candidates(setting), key=lambda c: error(c.setting))
        of_faults = list({c.fault: i for i, c in reversed(list(enumerate(found)))}.values())
        for i in {*range(min(0 if dear else 3, len(found))), *sorted(of_faults)[: 3 if dear else _HEADS]}:
            found[i] = found[i].descended(error)
        return sorted(found, key=lambda c: error(c.setting))

    chosen: list[Candidate[S]] = []
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
    """Return two of many parts of a sentence, and how many more there are."""
    return ", ".join(parts[:2]) + (f" and {len(parts) - 2} more" if len(parts) > 2 else "")
