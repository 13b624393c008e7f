"""Keyframes of attached models: each sets its model's part of the state; the rest keeps its default."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models import layout
from sim2real.composer.models.tree import Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.tree import Handle
    from sim2real.composer.types import MjModel, MjSpec


def restore(out: MjSpec, models: list[Tree[Handle]]) -> None:
    """Add the keyframes of all models to a composed spec, under their full names.

    Raises:
        UsageError: When a keyframe has another size than its model's part of the state.
    """
    compiled = out.compile()
    for model in models:
        for native in list(model._spec.keys):
            element = model.handle("key", native)
            key = out.add_key(name=model.prefix(None) + (native.name or element.full_identifier), time=native.time)
            for part in ("qpos", "qvel", "act", "ctrl", "mpos", "mquat"):
                values = np.array(getattr(native, part))
                if values.size:
                    setattr(key, part, _spread(compiled, model, element.full_identifier, part, values))


def _spread(compiled: MjModel, model: Tree[Handle], name: str, part: str, values: np.ndarray) -> np.ndarray:
    """Return a part of the state of the whole world that holds a model's values at the model's own places."""
    if part in ("mpos", "mquat"):
        whole = np.array(compiled.body_pos if part == "mpos" else compiled.body_quat)
        bodies = [e for e in model.find_all("body", exclude_attachments=True) if e._native.mocap]
        ids = layout.resolve(compiled, "body", tuple(e.full_identifier for e in bodies))
        mocap = np.argsort(compiled.body_mocapid)[-compiled.nmocap :]
        whole = whole[mocap]
        whole[compiled.body_mocapid[list(ids)]] = values.reshape(len(ids), -1)
        return whole.ravel()
    # Fill the model's own entries; the rest of the world keeps its default.
    kind, size = ("joint", f"n{part[1]}") if part[0] == "q" else ("actuator", "na" if part == "act" else "nu")
    whole = np.array(compiled.qpos0) if part == "qpos" else np.zeros(getattr(compiled, size))
    elements_here = [model.handle(kind, n) for n in getattr(model._spec, f"{kind}s")]
    frames = [e for e in elements_here if e.kind == "joint" and e.parent.is_frame]  # their joints came later
    rows = np.zeros(0)
    # The values may have been written before the frames got joints.
    for elements in (elements_here, [e for e in elements_here if e not in frames]):
        ids = layout.resolve(compiled, kind, tuple(e.full_identifier for e in elements))
        rows = np.atleast_1d(layout.index(compiled, layout.attributes(kind)[part], ids, False))
        if rows.size == values.size:
            whole[rows] = values
            return whole
    raise UsageError(f"keyframe {name!r} has {values.size} values for {part}, its model has {rows.size}")
