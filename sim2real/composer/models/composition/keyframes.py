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
    """Return a part of the state of the whole world that holds a keyframe's values at their places.

    The values are of the model itself, or of the model with all models that are attached below it.
    """
    kind, whole = _defaults(compiled, part)
    every = model.find_all("body" if kind == "mocap" else kind)
    every = [e for e in every if kind != "mocap" or e._native.mocap]
    elements_here = [e for e in every if e.root is model]
    frames = [e for e in elements_here if e.kind == "joint" and e.parent.is_frame]  # their joints came later
    sizes = []
    # The values may have been written before the frames got joints, or be of the whole world.
    for elements in (elements_here, [e for e in elements_here if e not in frames], every):
        rows = _rows(compiled, kind, part, [e.full_identifier for e in elements])
        if rows.size == values.size:
            whole[np.sort(rows) if elements is every else rows] = values
            return whole
        sizes.append(rows.size)
    below = f", and {sizes[2]} with the attached ones" if sizes[2] != sizes[0] else ""
    raise UsageError(f"keyframe {name!r} has {values.size} values for {part}, its model has {sizes[0]}{below}")


def _defaults(compiled: MjModel, part: str) -> tuple[str, np.ndarray]:
    """Return the kind of element that a part of the state is of, and the whole world's default."""
    if part in ("mpos", "mquat"):
        mocap = np.argsort(compiled.body_mocapid)[len(compiled.body_mocapid) - compiled.nmocap :]
        return "mocap", np.array(compiled.body_pos if part == "mpos" else compiled.body_quat)[mocap].ravel()
    kind, size = ("joint", f"n{part[1]}") if part[0] == "q" else ("actuator", "na" if part == "act" else "nu")
    return kind, np.array(compiled.qpos0) if part == "qpos" else np.zeros(getattr(compiled, size))


def _rows(compiled: MjModel, kind: str, part: str, names: list[str]) -> np.ndarray:
    """Return the places of elements in a part of the state of the whole world."""
    if kind != "mocap":
        ids = layout.resolve(compiled, kind, tuple(names))
        return np.atleast_1d(layout.index(compiled, layout.attributes(kind)[part], ids, False))
    width = 3 if part == "mpos" else 4
    first = width * compiled.body_mocapid[list(layout.resolve(compiled, "body", tuple(names)))]
    return (first[:, None] + np.arange(width)).ravel()
