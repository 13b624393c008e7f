"""Model and state of the C engine: MuJoCo's objects."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics.base import BaseModelView, NativeView


class ModelView(BaseModelView):
    """``physics.model``: the ``MjModel``."""

    __slots__ = ()

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


class DataView(NativeView):
    """``physics.data``: the ``MjData``."""

    __slots__ = ()
