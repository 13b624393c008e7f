"""Lists of elements, such as ``body.geom`` and ``sensor.gyro``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, Protocol, TypeVar


class Listed(Protocol):
    """An item of a list: an ``Element``."""

    @property
    def name(self) -> str | None:
        """Its name."""
        ...

    def remove(self) -> None:
        """Delete it."""


E = TypeVar("E", bound=Listed, covariant=True)


class ElementList(Sequence[E], Generic[E]):
    """Elements of one kind or tag in a body or a section; always those that are there now."""

    def __init__(self, find: Callable[[], Sequence[E]], tag: str) -> None:
        self._find, self._tag = find, tag

    def __len__(self) -> int:
        return len(self._find())

    def __getitem__(self, key: Any) -> Any:
        """Return an element by its number or its name, or a list of them for a slice."""
        elements = self._find()
        if not isinstance(key, str):
            return elements[key]
        named = [e for e in elements if e.name == key]
        if not named:
            raise KeyError(
                f"there is no <{self._tag}> {key!r}. Available: {', '.join(filter(None, (e.name for e in elements)))}"
            )
        return named[0]

    def __delitem__(self, key: int | str | slice) -> None:
        for element in self[key] if isinstance(key, slice) else [self[key]]:
            element.remove()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    def __add__(self, other: Iterable[E]) -> list[E]:
        return [*self, *other]

    def __radd__(self, other: Iterable[E]) -> list[E]:
        return [*other, *self]

    def __repr__(self) -> str:
        return repr(self._find())

    def clear(self) -> None:
        """Delete them all."""
        for element in self._find():
            element.remove()
