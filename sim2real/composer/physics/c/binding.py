"""Bound elements on MuJoCo's C engine: attributes read from and written to mjModel and mjData."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.models import layout
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from typing import Literal


class Staleness:
    """Whether something was written into a physics since everything was last computed.

    An object of its own, as every reading of a bound attribute asks for it.
    """

    __slots__ = ("dirty",)

    def __init__(self) -> None:
        self.dirty = False


class Place:
    """Where an attribute of bound elements lies.

    Attributes:
        array: MuJoCo's array.
        index: The rows in it.
        derived: Whether it is computed from others, and out of date once those are written.
        shown: What readers are given; None where they are given a number.
        plain: The same memory as a plain array.
    """

    __slots__ = ("array", "derived", "index", "plain", "shown")

    def __init__(self, array: np.ndarray, index: Any, derived: bool) -> None:
        self.array, self.derived = array, derived
        if isinstance(index, np.ndarray) and index.size and np.array_equal(index, index[0] + np.arange(index.size)):
            index = slice(int(index[0]), int(index[-1]) + 1)  # the same rows, several times faster
        self.index = index
        value = array[index]
        self.shown = None if value.ndim == 0 else value.copy().view(SyncedArray)
        self.plain = None if self.shown is None else self.shown.view(np.ndarray)


class SyncedArray(np.ndarray):
    """A part of a MuJoCo array: writing an item writes it there too, and marks what is computed from it.

    Reading it again through its binding brings the newest values.
    """

    _binding: Binding | None = None  # parts of this array do not take these over: they write to nothing
    _name: str = ""

    def __array_wrap__(
        self, array: np.ndarray, context: tuple[Any, ...] | None = None, return_scalar: bool = False
    ) -> Any:
        """Return what is computed from this array as a plain one: sums of products then take a third less time."""
        return array[()] if return_scalar else array

    def __setitem__(self, key: Any, value: Any) -> None:
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

    def __deepcopy__(self, memo: dict[int, Any] | None) -> np.ndarray:
        return self.copy()

    def __reduce__(self) -> str | tuple[Any, ...]:
        raise NotImplementedError("a bound array cannot be pickled: copy it first")


class Binding:
    """Elements of one kind in one physics: ``binding.qpos``, ``binding.xpos = ...``, ``binding['pos', [0, 2]]``.

    Attribute names are MuJoCo's without the kind's prefix. One element: a row, shape ``(...)``; several: ``(n, ...)``;
    what has several entries per element (``qpos``, ``qvel``, ``sensordata``) is concatenated.

    Args:
        single: Whether one element is bound, rather than a sequence of them.
    """

    __slots__ = ("_fields", "_ids", "_kind", "_physics", "_places", "_single", "_staleness", "element_id")

    def __init__(self, physics: Any, kind: str, ids: tuple[int, ...], single: bool) -> None:
        fields = layout.attributes(kind)
        if kind == "body" and any(physics.model.ptr.body_mocapid[i] < 0 for i in ids):
            fields = {k: v for k, v in fields.items() if v.size != "nmocap"}
        numbers: Any = ids[0] if single else np.array(ids)
        if not single:
            numbers.flags.writeable = False
        values = (fields, ids, kind, physics, {}, single, physics.staleness, numbers)
        for name, value in zip(Binding.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    def _field(self, name: str) -> layout.Field:
        try:
            return self._fields[name]
        except KeyError:
            known = ", ".join(sorted(self._fields))
            message = f"bound element <{self._kind}> does not have attribute {name!r}. Available: {known}"
            raise AttributeError(message) from None

    def _place(self, name: str) -> Place:
        """Return where an attribute lies, looked up once."""
        field = self._field(name)
        holder = self._physics.model.ptr if field.struct == "model" else self._physics.data.ptr
        index = layout.index(self._physics.model.ptr, field, self._ids, self._single)
        found = self._places[name] = Place(getattr(holder, field.name), index, not field.triggers)
        if found.shown is not None:
            found.shown._binding, found.shown._name = self, name
        return found

    def write(self, name: str, value: Any) -> None:
        """Set an attribute of all bound elements; what follows from earlier writes is computed before."""
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
        """Let go of MuJoCo's arrays."""
        self._places.clear()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        place = self._places.get(name) or self._place(name)
        if place.derived and self._staleness.dirty:
            self._physics.forward()
        if place.shown is None:
            return place.array[place.index]
        place.plain[...] = place.array[place.index]
        return place.shown

    def __setattr__(self, name: str, value: Any) -> None:
        self.write(name, value)

    def __getitem__(self, key: Any) -> Any:
        name, axes = key if isinstance(key, tuple) else (key, None)
        value = getattr(self, name)
        if axes is None:
            return value
        return np.asarray(value)[..., columns(axes)]

    def __setitem__(self, key: Any, value: Any) -> None:
        name, axes = key if isinstance(key, tuple) else (key, None)
        if axes is None:
            self.write(name, value)
            return
        whole = np.array(getattr(self, name))
        whole[..., columns(axes)] = value
        self.write(name, whole)

    def __dir__(self) -> list[str]:
        return sorted({*self._fields, "element_id"})


class EmptyBinding:
    """No elements: every attribute is an empty array, and none can be set."""

    __slots__ = ()
    element_id = np.zeros(0, int)

    def free(self) -> None:
        """Do nothing: there is nothing to let go of."""

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith("__"):
            raise AttributeError(name)
        return np.empty(0)

    def __setattr__(self, name: str, value: Any) -> None:
        raise UsageError("Cannot assign a value to an empty binding.")


def columns(key: Any) -> Any:
    """Return column numbers for names of axes such as ``'x'`` or ``['x', 'z']``."""
    axes = {name: i for i, name in enumerate("xyz")}
    if isinstance(key, str):
        return axes[key]
    if isinstance(key, list | tuple):
        return [axes[k] if isinstance(k, str) else k for k in key]
    return key
