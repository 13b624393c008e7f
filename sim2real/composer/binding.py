"""Bound elements on MuJoCo's C engine: attributes read from and written to mjModel and mjData."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim2real.composer import layout
from sim2real.errors import UsageError


class SyncedArray(np.ndarray):
    """A part of a MuJoCo array: writing an item writes it there too, and marks what is computed from it.

    Reading it again through its binding brings the newest values.
    """

    _binding: Binding | None = None
    _name: str = ""

    def __array_finalize__(self, obj: Any) -> None:
        """Let arrays that are computed from this one be plain: they write to nothing."""
        self._binding = None

    def __setitem__(self, key: Any, value: Any) -> None:
        binding = self._binding
        if binding is None:
            super().__setitem__(key, value)
            return
        binding.refresh(self._name)
        super().__setitem__(key, value)
        binding.write(self._name, np.asarray(self))

    def copy(self, order: Any = "C") -> np.ndarray:
        """Return a plain array."""
        return np.array(self, order=order, subok=False)

    def __copy__(self) -> np.ndarray:
        return self.copy()

    def __deepcopy__(self, memo: Any) -> np.ndarray:
        return self.copy()

    def __reduce__(self) -> Any:
        raise NotImplementedError("a bound array cannot be pickled: copy it first")


class Binding:
    """Elements of one kind in one physics: ``binding.qpos``, ``binding.xpos = ...``, ``binding['pos', [0, 2]]``.

    Attribute names are MuJoCo's without the kind's prefix. One element: a row, shape ``(...)``; several: ``(n, ...)``;
    what has several entries per element (``qpos``, ``qvel``, ``sensordata``) is concatenated.
    """

    __slots__ = ("_arrays", "_fields", "_ids", "_indices", "_kind", "_physics", "_single", "element_id")

    def __init__(self, physics: Any, kind: str, ids: tuple[int, ...], single: bool) -> None:
        fields = layout.attributes(kind)
        if kind == "body" and any(physics.model.ptr.body_mocapid[i] < 0 for i in ids):
            fields = {k: v for k, v in fields.items() if v.size != "nmocap"}
        numbers: Any = ids[0] if single else np.array(ids)
        if not single:
            numbers.flags.writeable = False
        values = (physics, kind, ids, single, fields, {}, {}, numbers)
        names = ("_physics", "_kind", "_ids", "_single", "_fields", "_indices", "_arrays", "element_id")
        for name, value in zip(names, values, strict=True):
            object.__setattr__(self, name, value)

    def _field(self, name: str) -> layout.Field:
        try:
            return self._fields[name]
        except KeyError:
            known = ", ".join(sorted(self._fields))
            message = f"bound element <{self._kind}> does not have attribute {name!r}. Available: {known}"
            raise AttributeError(message) from None

    def _place(self, name: str) -> tuple[np.ndarray, Any]:
        """Return the array that holds an attribute, and the index of the bound rows in it."""
        found = self._indices.get(name)
        if found is None:
            field = self._field(name)
            holder = self._physics.model.ptr if field.struct == "model" else self._physics.data.ptr
            array = getattr(holder, field.name)
            index = layout.index(self._physics.model.ptr, field, self._ids, self._single)
            found = self._indices[name] = array, index
        return found

    def refresh(self, name: str) -> None:
        """Recompute what follows from earlier writes, when this attribute is one of the computed ones."""
        if self._physics.is_dirty and not self._field(name).triggers:
            self._physics.forward()

    def write(self, name: str, value: Any) -> None:
        """Set an attribute of all bound elements."""
        field = self._field(name)
        self.refresh(name)
        array, index = self._place(name)
        array[index] = value
        for other in layout.DISABLED_BY.get(field.name, ()):
            getattr(self._physics.model.ptr, other)[list(self._ids)] = 0
        if field.triggers:
            self._physics.mark_as_dirty()

    def free(self) -> None:
        """Let go of MuJoCo's arrays."""
        self._indices.clear()
        self._arrays.clear()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self.refresh(name)
        array, index = self._place(name)
        if isinstance(index, int) and array.ndim == 1:
            return array[index]
        cached = self._arrays.get(name)
        if cached is not None:
            np.copyto(cached.view(np.ndarray), array[index])
            return cached
        made = array[index].view(SyncedArray)
        made._binding, made._name = self, name
        self._arrays[name] = made
        return made

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
