"""What hooks see of a model and a state on MJX: arrays that they may set, and constants that they can only read."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.physics import layout
from sim2real.composer.physics.base import BaseBinding, BaseModelView, BasePhysics
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from mujoco import mjx

    from sim2real.composer.types import ArrayLike, Index, MjModel
    from sim2real.types import PyTree

_MATRICES = ("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat")
"""MJX keeps them as ``(n, 3, 3)``, MuJoCo as ``(n, 9)``."""


class Traced(BasePhysics):
    """An ``MjxPhysics`` for its views: setting an attribute replaces its state or its model."""

    host: MjModel
    mjx_model: mjx.Model
    mjx_data: mjx.Data

    @abstractmethod
    def read(self, field: layout.Field) -> PyTree:
        """Return a whole field."""

    @abstractmethod
    def check(self, struct: str, name: str, rows: Index) -> None:
        """Refuse to set rows of a field of the ``model`` or the ``data`` where MJX would ignore it."""

    @abstractmethod
    def replace(self, struct: str, name: str, value: ArrayLike) -> None:
        """Set a whole field of the ``model`` or the ``data``."""


def constant(name: str) -> UsageError:
    """Return the error that a field cannot be set."""
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

    def __getitem__(self, key: Index) -> PyTree:
        part = super().__getitem__(key)
        if isinstance(part, ConstantView):
            part.name = self.name
        return part

    def __setitem__(self, key: Index, value: object) -> None:
        if self.name:
            raise constant(self.name)
        super().__setitem__(key, value)


class Struct:
    """A part of the compiled ``MjModel``, such as ``stat``: it can only be read."""

    def __init__(self, native: object, name: str) -> None:
        object.__setattr__(self, "_native", native)
        object.__setattr__(self, "_name", name)

    def __getattr__(self, name: str) -> PyTree:
        return shown(getattr(self._native, name), f"{self._name}.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        raise constant(f"{self._name}.{name}")


def shown(value: PyTree, name: str) -> PyTree:
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

    def __getattr__(self, name: str) -> PyTree:
        value = getattr(self._physics.mjx_model.opt, name, None)
        return value if isinstance(value, jax.Array) else shown(getattr(self._physics.host.opt, name), f"opt.{name}")

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("model", f"opt.{name}", value)


class MjxModelView(BaseModelView):
    """``physics.model``: fields that differ from copy to copy come from MJX, all others from the ``MjModel``."""

    def __init__(self, physics: Traced) -> None:
        super().__init__(physics.host)
        object.__setattr__(self, "_physics", physics)
        object.__setattr__(self, "opt", OptionView(physics))

    def __getattr__(self, name: str) -> PyTree:
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

    def __getattr__(self, name: str) -> PyTree:
        if name.startswith("__"):
            raise AttributeError(name)
        data = self._physics.mjx_data
        value = getattr(data, name) if name in data.__dataclass_fields__ else getattr(data._impl, name)
        if value is None:  # what all copies have in common on Warp
            raise AttributeError(f"a copy has no {name!r} of its own")
        return jnp.reshape(value, (-1, 9)) if name in _MATRICES else value

    def __setattr__(self, name: str, value: ArrayLike) -> None:
        self._physics.replace("data", name, value)


class MjxBinding(BaseBinding):
    """Bound elements on MJX: attributes are JAX arrays; setting one replaces the physics's state or model."""

    __slots__ = ()
    _physics: Traced

    def read(self, name: str) -> PyTree:
        """Return an attribute of all bound elements."""
        field, index = self.locate(name)
        return self._physics.read(field)[index]

    def write(self, name: str, value: ArrayLike) -> None:
        """Set an attribute of all bound elements."""
        field, index = self.locate(name)
        array = jnp.asarray(self._physics.read(field))
        self._physics.check(field.struct, field.name, index)
        self._physics.replace(field.struct, field.name, array.at[index].set(jnp.asarray(value, array.dtype)))
        if field.triggers:
            self._physics.mark_as_dirty()


def freeze(model: MjModel) -> None:
    """Make the arrays of a compiled ``MjModel`` read-only: programs no longer look at them."""
    for name in layout.array_fields("model"):
        array = getattr(model, name)
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
