"""Images of a physics, by ``mujoco.Renderer``: one for each thread and size, as OpenGL's contexts belong to threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from sim2real.composer.types import MjData, MjModel, MjvOption, MjvScene


class Images:
    """Draws a model. Textures and height fields are those that it had when a thread drew its first image of a size."""

    def __init__(self, model: MjModel) -> None:
        self._model = model
        self._renderers: dict[tuple[int, int, int], Any] = {}

    def draw(
        self,
        data: MjData,
        height: int,
        width: int,
        camera_id: int | str = -1,
        depth: bool = False,
        segmentation: bool = False,
        scene_option: MjvOption | None = None,
        flags: Mapping[str | int, bool] | None = None,
        scene_callback: Callable[[MjvScene], None] | None = None,
    ) -> np.ndarray:
        """Return an image; see ``Physics.render``."""
        if depth and segmentation:
            raise UsageError("`segmentation` and `depth` cannot both be `True`.")
        if isinstance(camera_id, int) and not -1 <= camera_id < self._model.ncam:
            raise UsageError(f"model has {self._model.ncam} fixed cameras. camera_id={camera_id} is invalid.")
        for name, size in (("width", width), ("height", height)):
            most = getattr(self._model.vis.global_, f"off{name}")
            if size > most:
                raise UsageError(
                    f"Image {name} {size} > framebuffer {name} {most}",
                    hint=f'a smaller image, or `<visual><global off{name}="{size}"/></visual>` in the model',
                )
        wanted = {_flag(name): value for name, value in (flags or {}).items()}
        place = threading.get_ident(), height, width
        if place not in self._renderers:
            self._renderers[place] = mj.Renderer(self._model, height, width)
        renderer = self._renderers[place]
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if depth:
            renderer.enable_depth_rendering()
        if segmentation:
            renderer.enable_segmentation_rendering()
        option = getattr(scene_option, "ptr", scene_option)
        renderer.update_scene(data, camera_id, option)
        before = renderer.scene.flags.copy()
        try:
            for flag, value in wanted.items():
                renderer.scene.flags[flag] = value
            if scene_callback is not None:
                scene_callback(renderer.scene)
            return renderer.render()
        finally:
            renderer.scene.flags[:] = before

    def close(self) -> None:
        """Free the renderers of this thread, and let go of those of others."""
        for (thread, *_), renderer in self._renderers.items():
            if thread == threading.get_ident():
                renderer.close()
        self._renderers.clear()


def _flag(name: str | int) -> int:
    names = {k.removeprefix("mjRND_").lower(): int(v) for k, v in mj.mjtRndFlag.__members__.items()}
    if isinstance(name, str) and name not in names:
        raise UsageError(f"there is no render flag {name!r}. Available: {', '.join(names)}")
    return names[name] if isinstance(name, str) else int(name)
