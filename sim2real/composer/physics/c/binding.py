"""Bound elements on MuJoCo's C engine: attributes read from and written to mjModel and mjData."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.physics import layout
from sim2real.composer.physics.base import BaseBinding, BasePhysics

if TYPE_CHECKING:
    from typing import Literal

    from sim2real.composer.types import ArrayLike, Index
    from sim2real.types import PyTree


class Staleness:
    """Whether a physics was written to since all quantities were last computed.

    A separate object, as every read of a bound attribute looks it up.
    """

    __slots__ = ("dirty",)

    def __init__(self) -> None:
        self.dirty = False


class BoundPhysics(BasePhysics):
    """A physics whose bindings read and write MuJoCo's arrays."""

    staleness: Staleness

    @abstractmethod
    def count_compensated(self) -> None:
        """Count the bodies that are compensated for gravity, where none was in the compiled model."""


class Place:
    """The place of an attribute of bound elements.

    Attributes:
        index: The rows in it.
        derived: Whether it is computed from other attributes, and out of date once those are written.
        shown: The array that readers get; None where they get a number.
        plain: The memory of ``shown`` as a plain array.
    """

    __slots__ = ("array", "derived", "index", "plain", "shown")

    def __init__(self, array: np.ndarray, index: Index, derived: bool) -> None:
        self.array, self.derived = array, derived
        if isinstance(index, np.ndarray) and index.size and np.array_equal(index, index[0] + np.arange(index.size)):
            index = slice(int(index[0]), int(index[-1]) + 1)  # the same rows, several times faster
        self.index = index
        value = array[index]
        self.shown = None if value.ndim == 0 else value.copy().view(SyncedArray)
        self.plain = None if self.shown is None else self.shown.view(np.ndarray)


class SyncedArray(np.ndarray):
    """A part of a MuJoCo array: writing an item writes it there too, and marks computed quantities.

    Reading it again through its binding brings the newest values.
    """

    _binding: Binding | None = None  # parts of this array do not take these over: they write to nothing
    _name: str = ""

    def __array_wrap__(
        self, array: np.ndarray, context: tuple[Any, ...] | None = None, return_scalar: bool = False
    ) -> PyTree:
        """Return results of functions of this array as plain arrays: sums of products then take a third less time."""
        return array[()] if return_scalar else array

    def __setitem__(self, key: Index, value: object) -> None:
        binding = self._binding
        if binding is None:
            super().__setitem__(key, value)
            return
        value = np.array(value)  # it may be a part of this array: `array[1:] *= 2` changes that before it comes here
        getattr(binding, self._name)  # which brings the newest values here
        super().__setitem__(key, value)
        binding.write(self._name, np.asarray(self))

    def copy(self, order: Literal["K", "A", "C", "F"] | None = "C") -> np.ndarray:
        """Return a plain array."""
        return np.array(self, order=order, subok=False)

    def __copy__(self) -> np.ndarray:
        return self.copy()

    def __deepcopy__(self, memo: dict[int, object] | None) -> np.ndarray:
        return self.copy()

    def __reduce__(self) -> str | tuple[Any, ...]:
        raise NotImplementedError("a bound array cannot be pickled: copy it first")


class Binding(BaseBinding):
    """Bound elements on MuJoCo's C engine; see ``BaseBinding``. Writing an item of an array writes it to MuJoCo."""

    __slots__ = ("_places", "_staleness")
    _physics: BoundPhysics
    _places: dict[str, Place]
    _staleness: Staleness

    def __init__(self, physics: BoundPhysics, kind: str, ids: tuple[int, ...], single: bool) -> None:
        super().__init__(physics, kind, ids, single)
        object.__setattr__(self, "_places", {})
        object.__setattr__(self, "_staleness", physics.staleness)

    def _place(self, name: str) -> Place:
        """Return the place of an attribute, and keep it for the next access."""
        field, index = self.locate(name)
        holder = self._physics.model.ptr if field.struct == "model" else self._physics.data.ptr
        place = self._places[name] = Place(getattr(holder, field.name), index, not field.triggers)
        if place.shown is not None:
            place.shown._binding, place.shown._name = self, name
        return place

    def write(self, name: str, value: ArrayLike) -> None:
        """Set an attribute of all bound elements; quantities that follow from earlier writes are computed before."""
        place = self._places.get(name) or self._place(name)
        if not place.derived:
            self._staleness.dirty = True
        elif self._staleness.dirty:
            self._physics.forward()
        place.array[place.index] = value
        for other in layout.DISABLED_BY.get(self._fields[name].name, ()):
            getattr(self._physics.model.ptr, other)[list(self._ids)] = 0
        if name == "gravcomp" and not self._physics.model.ptr.ngravcomp:
            self._physics.count_compensated()

    def free(self) -> None:
        """Drop the references to MuJoCo's arrays."""
        self._places.clear()

    def read(self, name: str) -> PyTree:
        """Return an attribute of all bound elements; out-of-date quantities are computed first."""
        place = self._places.get(name) or self._place(name)
        if place.derived and self._staleness.dirty:
            self._physics.forward()
        if place.plain is None:
            return place.array[place.index]
        place.plain[...] = place.array[place.index]
        return place.shown

    def _plain(self, array: PyTree) -> np.ndarray:
        return np.asarray(array)
