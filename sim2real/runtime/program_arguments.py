"""Objects whose numbers can be arguments of a compiled program, so that other numbers need no other program."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar, runtime_checkable

T = TypeVar("T")


@runtime_checkable
class HoldsData(Protocol):
    """An object whose methods are traced, with numbers that follow from a recording."""

    @property
    def data(self) -> Any:
        """The numbers, a pytree of arrays. Its structure and shapes belong to the program."""
        ...

    def with_data(self, data: Any) -> Any:
        """Return a copy that uses other numbers, which may be traced."""
        ...


def data_of(holder: object) -> Any:
    """Return an object's data; None if it holds none."""
    return holder.data if isinstance(holder, HoldsData) else None


def with_data(holder: T, data: Any) -> T:
    """Return a copy of an object with other data; the object itself if there are none."""
    changed: Any = holder.with_data(data) if data is not None and isinstance(holder, HoldsData) else holder
    return changed
