"""Images of a model and its state."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.composer.translate import mj
from sim2real.errors import UsageError

_UPLOADED = ("hfield_data", "tex_data", "mesh_vert")
"""What a renderer copies to the graphics device when it is made."""


class Renderers:
    """Renders images with one ``mujoco.Renderer`` for each size, kept from image to image: making one takes far longer.

    One is made anew when the model's height fields, textures or meshes have changed since, and for every thread, as
    the contexts of the graphics device belong to threads.

    Args:
        model: The ``mujoco.MjModel``.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self._kept: dict[tuple[int, int, int], tuple[Any, list[np.ndarray]]] = {}

    def _renderer(self, height: int, width: int) -> Any:
        key = (threading.get_ident(), height, width)
        renderer, uploaded = self._kept.get(key, (None, []))
        fields = [getattr(self._model, name) for name in _UPLOADED]
        if renderer is not None and not all(map(np.array_equal, fields, uploaded)):
            renderer.close()
            renderer = None
        if renderer is None:
            renderer = mj.Renderer(self._model, height, width)
            self._kept[key] = renderer, [field.copy() for field in fields]
        return renderer

    def render(
        self,
        data: Any,
        size: tuple[int, int],
        camera: int | str,
        depth: bool = False,
        segmentation: bool = False,
        scene_option: Any = None,
        flags: Mapping[Any, bool] | None = None,
    ) -> np.ndarray:
        """Return an image.

        Args:
            data: The ``mujoco.MjData``.
            size: Height and width [pixels].
            camera: Number or name; -1 is the free camera.
            depth: Measure distances [m] instead of colours.
            segmentation: Number the objects instead.
            scene_option: What is drawn: an ``MjvOption``.
            flags: Flags of ``mjtRndFlag``, by name in small letters, such as ``shadow``, or by number -> value.

        Raises:
            UsageError: When depth and segmentation are both asked for, or there is no such flag.
        """
        if depth and segmentation:
            raise UsageError("Only one of depth or segmentation can be rendered at a time.")
        renderer = self._renderer(*size)
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if depth:
            renderer.enable_depth_rendering()
        if segmentation:
            renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera, getattr(scene_option, "ptr", scene_option))
        shown = renderer.scene.flags
        before = shown.copy()
        for flag, value in (flags or {}).items():
            shown[_flag(flag)] = value
        image = renderer.render()
        shown[:] = before
        return image

    def close(self) -> None:
        """Let go of the graphics device."""
        for renderer, _ in self._kept.values():
            renderer.close()
        self._kept.clear()


def _flag(name: Any) -> int:
    if not isinstance(name, str):
        return int(name)
    known = {k.removeprefix("mjRND_").lower(): v for k, v in mj.mjtRndFlag.__members__.items() if k != "mjNRNDFLAG"}
    if name not in known:
        raise UsageError(f"there is no render flag {name!r}. Available: {', '.join(known)}")
    return int(known[name])
