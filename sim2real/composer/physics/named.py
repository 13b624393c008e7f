"""Arrays of mjModel and mjData indexed by name: ``physics.named.data.xpos['hand', 'z']``."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from sim2real.arrays import is_jax
from sim2real.composer.mjcf.element import Element
from sim2real.composer.physics import layout

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy.typing as npt

    from sim2real.composer.types import Index, MjModel
    from sim2real.types import PyTree

_KIND_OF_SIZE = {size: name for name, kind in layout.KINDS.items() for size in kind.sizes}


class NamedArray(NDArrayOperatorsMixin):
    """An array whose rows can also be indexed by names or elements.

    A list of rows with a list of columns gives pairs, as in numpy; ``np.ix_`` gives all combinations.

    The models before a name may be left out, if only one element's name ends with it.

    Args:
        holder: The model or the data that has the array as an attribute.
    """

    def __init__(self, model: MjModel, field: layout.Field, holder: object) -> None:
        self._model, self._field, self._holder = model, field, holder

    @property
    def _array(self) -> PyTree:
        return getattr(self._holder, self._field.name)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self._array, dtype=dtype) if copy else np.asarray(self._array, dtype=dtype)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: PyTree, **kwargs: PyTree) -> PyTree:
        plain = [x._array if isinstance(x, NamedArray) else x for x in inputs]
        return getattr(ufunc, method)(*plain, **kwargs)

    def __getattr__(self, name: str) -> PyTree:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._array, name)

    def __len__(self) -> int:
        return len(self._array)

    def __iter__(self) -> Iterator[PyTree]:
        return iter(self._array)

    def __repr__(self) -> str:
        return f"{self._field.name}: {self._array!r}"

    def __getitem__(self, key: Index) -> PyTree:
        return self._array[self.rows(key)]

    def __setitem__(self, key: Index, value: PyTree) -> None:
        array, rows = self._array, self.rows(key)
        if is_jax(array):
            setattr(self._holder, self._field.name, array.at[rows].set(value))
        else:
            array[rows] = value

    @property
    def axes(self) -> SimpleNamespace:
        """``axes.row.convert_key_item(names)`` returns the rows of some names, as in dm_control."""
        return SimpleNamespace(row=SimpleNamespace(convert_key_item=self._rows))

    def rows(self, key: Index) -> Index:
        """Return the numeric index for a key of names, elements or numbers.

        Raises:
            KeyError: No element, or more than one, has the name.
        """
        if isinstance(key, tuple):
            row, *columns = key
            return (self._rows(row), *map(layout.columns, columns))
        return self._rows(key)

    def _rows(self, key: Index) -> Index:
        if isinstance(key, str | Element):
            return layout.index(self._model, self._field, (self._number(key),), True)
        if isinstance(key, np.ndarray) and key.dtype.kind == "U":  # arrays of names from np.ix_
            return np.reshape(self._rows(key.ravel().tolist()), key.shape)
        if isinstance(key, Iterable) and not isinstance(key, np.ndarray):
            keys = list(key)
            if keys and isinstance(keys[0], str | Element):
                return layout.index(self._model, self._field, tuple(self._number(k) for k in keys), False)
            return np.asarray(keys) if keys else keys
        return key

    def _number(self, key: str | Element) -> int:
        name = key.full_identifier if isinstance(key, Element) else key
        kind = _KIND_OF_SIZE.get(self._field.size)
        if kind is None:
            raise KeyError(f"{self._field.name} has no named rows")
        names = layout.names_of(self._model, kind)
        if name in names:
            return names.index(name)
        ending = [i for i, full in enumerate(names) if full.endswith(f"/{name}")]
        if len(ending) == 1:
            return ending[0]
        what = "is ambiguous" if ending else "is not there"
        available = ", ".join(names[i] for i in ending) if ending else ", ".join(names)
        raise KeyError(f"{self._field.name}: {kind} {name!r} {what}. Available: {available}")


class NamedFields:
    """The arrays of ``model`` or ``data``, each as a ``NamedArray``."""

    def __init__(self, model: MjModel, struct: str, holder: object) -> None:
        self._model, self._struct, self._holder = model, struct, holder

    def __getattr__(self, name: str) -> NamedArray:
        if name.startswith("__"):
            raise AttributeError(name)
        field = layout.array_fields(self._struct).get(name)
        if field is None:
            raise AttributeError(f"{self._struct} has no array {name!r}")
        array = self.__dict__[name] = NamedArray(self._model, field, self._holder)
        return array


class Named:
    """``physics.named``: the arrays of ``named.model`` and ``named.data`` by name."""

    def __init__(self, model: MjModel, model_holder: object, data_holder: object) -> None:
        self.model = NamedFields(model, "model", model_holder)
        self.data = NamedFields(model, "data", data_holder)
