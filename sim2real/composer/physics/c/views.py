"""What hooks see of a model and a state on the C engine: MuJoCo's objects, and names to numbers and back."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from sim2real.composer.models import layout
from sim2real.composer.models.mjcf.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjData, MjModel


class _Wrapper:
    """An mjModel or mjData whose attributes are those of ``ptr``, the native object."""

    __slots__ = ("ptr",)

    def __init__(self, ptr: MjModel | MjData) -> None:
        object.__setattr__(self, "ptr", ptr)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.ptr, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.ptr, name, value)


def _kind(kind: str | int) -> str:
    if isinstance(kind, str):
        return kind
    kinds = {int(number): name for name, number in layout.OBJECT_TYPES.items()}
    if int(kind) not in kinds:
        raise UsageError(f"no elements have the mjtObj {kind}. Available: {', '.join(layout.OBJECT_TYPES)}")
    return kinds[int(kind)]


class ModelView(_Wrapper):
    """``physics.model``: the ``MjModel``, and names to numbers and back."""

    __slots__ = ()

    def name2id(self, name: str, kind: str | int) -> int:
        """Return the number of the element of a kind, or ``mjtObj``, with a name; UsageError when there is none."""
        return layout.resolve(self.ptr, _kind(kind), (name,))[0]

    def id2name(self, number: int, kind: str | int) -> str:
        """Return the name of an element of a kind, or ``mjtObj``; '' when it has none."""
        return mj.mj_id2name(self.ptr, layout.OBJECT_TYPES[_kind(kind)], number) or ""

    @contextlib.contextmanager
    def disable(self, *flags: str) -> Iterator[None]:
        """Switch parts of the physics off, such as ``'actuation'`` or ``'contact'``, inside a ``with`` block."""
        before = self.ptr.opt.disableflags
        try:
            for flag in flags:
                self.ptr.opt.disableflags |= int(getattr(mj.mjtDisableBit, f"mjDSBL_{flag.upper()}"))
            yield
        finally:
            self.ptr.opt.disableflags = before


class DataView(_Wrapper):
    """``physics.data``: the ``MjData``."""

    __slots__ = ()
