"""What hooks see of a model and a state on MJX: arrays that they may set, and constants that they can only read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.models import layout
from sim2real.composer.physics.c.binding import columns
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from jax.typing import ArrayLike
    from mujoco import mjx

    from sim2real.composer.types import MjModel

_MATRICES = ("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat")
"""MJX keeps them as ``(n, 3, 3)``, MuJoCo as ``(n, 9)``."""


class Traced(Protocol):
    """What is shown here: an ``MjxPhysics``, whose state and model are replaced when something is set."""

    host: MjModel
    mjx_model: mjx.Model
    mjx_data: mjx.Data

    def read(self, field: layout.Field) -> Any:
        """Return a whole field."""
        ...

    def check(self, struct: str, name: str, rows: int | slice | np.ndarray) -> None:
        """Refuse what cannot be set."""

    def replace(self, struct: str, name: str, value: ArrayLike) -> None:
        """Set a whole field."""

    def mark_as_dirty(self) -> None:
        """Note that what is computed is out of date."""


def constant(name: str) -> UsageError:
    """Return what says that a field cannot be set."""
    return UsageError(
        f"MJX cannot change {name!r} inside a compiled program: it is one of its constants",
        hint="set it in initialize_episode_mjcf or after_compile, which run before that, or use the C engine",
    )


class ConstantView(np.ndarray):
    """An array that is the same in all copies: writing into it is refused, by name."""

    name: str = ""

    def __array_finalize__(self, obj: np.ndarray | None) -> None:
        """Let arrays that are computed from this one be plain."""
        self.name = ""

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        if isinstance(part, ConstantView):
            part.name = self.name
        return part

    def __setitem__(self, key: Any, value: Any) -> None:
        if self.name:
            raise constant(self.name)
        super().__setitem__(key, value)


class Struct:
    """A part of the compiled ``MjModel``, such as ``stat``: it can only be read."""

    def __init__(self, native: Any, name: str) -> None:
        object.__setattr__(self, "_native", native)
        object.__setattr__(self, "_name", name)

    def __getattr__(self, name: str) -> Any:
        return shown(getattr(self._native, name), f"{self._name}.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        raise constant(f"{self._name}.{name}")


def shown(value: Any, name: str) -> Any:
    """Return a value of the compiled model as hooks may see it."""
    if isinstance(value, np.ndarray):
        view = value.view(ConstantView)
        view.flags.writeable = False
        view.name = name
        return view
    return Struct(value, name) if type(value).__module__.startswith("mujoco") and not callable(value) else value


class OptionView:
    """``physics.model.opt``: gravity, wind and so on belong to each copy and can be set; the rest is constant."""

    def __init__(self, physics: Traced) -> None:
        object.__setattr__(self, "_physics", physics)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._physics.mjx_model.opt, name, None)
        return value if isinstance(value, jax.Array) else shown(getattr(self._physics.host.opt, name), f"opt.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("model", f"opt.{name}", value)


class MjxModelView:
    """``physics.model``: what differs from copy to copy comes from MJX, the rest from ``ptr``, the ``MjModel``."""

    def __init__(self, physics: Traced) -> None:
        object.__setattr__(self, "_physics", physics)
        object.__setattr__(self, "opt", OptionView(physics))

    @property
    def ptr(self) -> MjModel:
        """The compiled ``mujoco.MjModel``; its arrays are read-only."""
        return self._physics.host

    def name2id(self, name: str, kind: str) -> int:
        """Return the number of an element; UsageError when there is none of that name."""
        return layout.resolve(self.ptr, kind, (name,))[0]

    def id2name(self, number: int, kind: str) -> str:
        """Return the name of an element, '' when it has none."""
        return layout.names_of(self.ptr, kind)[number]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        model = self._physics.mjx_model
        value = getattr(model, name) if name in model.__dataclass_fields__ else None
        return value if isinstance(value, jax.Array) else shown(getattr(self.ptr, name), name)

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("model", name, value)


class MjxDataView:
    """``physics.data``: fields of the state, in MuJoCo's shapes."""

    def __init__(self, physics: Traced) -> None:
        object.__setattr__(self, "_physics", physics)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        data = self._physics.mjx_data
        value = getattr(data, name) if name in data.__dataclass_fields__ else getattr(data._impl, name)
        if value is None:  # what all copies have in common on Warp
            raise AttributeError(f"a copy has no {name!r} of its own")
        return jnp.reshape(value, (-1, 9)) if name in _MATRICES else value

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("data", name, value)


class MjxBinding:
    """Bound elements on MJX: attributes are JAX arrays; setting one replaces the physics's state or model.

    Args:
        single: Whether one element is bound, rather than a sequence of them.
    """

    __slots__ = ("_fields", "_ids", "_kind", "_physics", "_single", "element_id")

    def __init__(self, physics: Traced, kind: str, ids: tuple[int, ...], single: bool) -> None:
        numbers = ids[0] if single else np.array(ids, int)
        values = (layout.attributes(kind), ids, kind, physics, single, numbers)
        for name, value in zip(self.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    def place(self, name: str) -> tuple[layout.Field, Any]:
        """Return the field that holds an attribute and the index of the bound rows in it."""
        field = self._fields.get(name)
        if field is None:
            known = ", ".join(sorted(self._fields))
            raise AttributeError(f"bound element <{self._kind}> does not have attribute {name!r}. Available: {known}")
        return field, layout.index(self._physics.host, field, self._ids, self._single)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        field, index = self.place(name)
        return self._physics.read(field)[index]

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        field, index = self.place(name)
        array = jnp.asarray(self._physics.read(field))
        self._physics.check(field.struct, field.name, index)
        self._physics.replace(field.struct, field.name, array.at[index].set(jnp.asarray(value, array.dtype)))
        if field.triggers:
            self._physics.mark_as_dirty()

    def __getitem__(self, key: Any) -> Any:
        name, axes = key if isinstance(key, tuple) else (key, None)
        value = getattr(self, name)
        return value if axes is None else value[..., columns(axes)]

    def __setitem__(self, key: Any, value: Any) -> None:
        name, axes = key if isinstance(key, tuple) else (key, None)
        if axes is not None:
            whole = jnp.asarray(getattr(self, name))
            value = whole.at[..., columns(axes)].set(jnp.asarray(value, whole.dtype))
        setattr(self, name, value)


def freeze(model: MjModel) -> None:
    """Make the arrays of a compiled ``MjModel`` read-only: programs no longer look at them."""
    for name in layout.array_fields("model"):
        array = getattr(model, name)
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
