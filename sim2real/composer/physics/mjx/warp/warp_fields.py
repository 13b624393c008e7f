"""Which models are MuJoCo Warp's, and which of their fields may differ from copy to copy."""

from __future__ import annotations

from mujoco import mjx

from sim2real.errors import UsageError


def varies(path: str) -> bool:
    """Return whether a field of the model, such as ``body_mass`` or ``opt.gravity``, may differ from copy to copy."""
    from mujoco.mjx.warp import types

    return bool(types._BATCH_DIM["Model"].get(path.replace(".", "__")))


def check_field(path: str) -> None:
    """Refuse a field of the model that cannot differ from copy to copy; UsageError with the field."""
    if not varies(path):
        raise UsageError(
            f"MJX-Warp cannot change {path!r}: it is the same in all copies",
            hint='set it in the model before it is compiled, or use impl="jax"',
        )


def is_warp(model: mjx.Model) -> bool:
    """Return whether an ``mjx.Model`` is MuJoCo Warp's."""
    return model.impl == mjx.Impl.WARP
