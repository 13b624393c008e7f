"""Objects whose numbers are arguments of a compiled program: other numbers do not need another program."""

from typing import Protocol, TypeVar, runtime_checkable

from sim2real.types import PyTree

T = TypeVar("T")


@runtime_checkable
class HoldsData(Protocol):
    """An object whose methods are traced, with numbers from a recording."""

    @property
    def data(self) -> PyTree:
        """The numbers, a pytree of arrays. Its structure and shapes belong to the program."""
        ...

    def with_data(self, data: PyTree) -> PyTree:
        """Return a copy of this object with other numbers, which may be traced."""
        ...


def data_of(holder: object) -> PyTree:
    """Return an object's data; None if it is no ``HoldsData``."""
    return holder.data if isinstance(holder, HoldsData) else None


def with_data(holder: T, data: PyTree) -> T:
    """Return a copy of an object with other data; the object unchanged if ``data`` is None."""
    changed: PyTree = holder.with_data(data) if data is not None and isinstance(holder, HoldsData) else holder
    return changed
