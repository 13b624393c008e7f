"""OpenGL for the images of a model: contexts, uploaded data, and pixels."""

from __future__ import annotations

import atexit
import functools
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjModel, MjrContext, MjrRect, MjvScene

_UPLOADED = {
    "hfield_data": ("nhfield", "mjr_uploadHField"),
    "tex_data": ("ntex", "mjr_uploadTexture"),
    "mesh_vert": ("nmesh", "mjr_uploadMesh"),
}
"""Arrays that a context has a copy of: array -> the number of its objects, and the function that uploads one."""
_ABANDONED: list[MjrContext] = []
"""Contexts of MuJoCo in threads that are no more. Their destructors would free the objects of whichever context is
current; OpenGL frees theirs itself."""


class _Context:
    """What one thread draws a model with, into a buffer of the model's ``offwidth`` and ``offheight``.

    dm_control has one for all sizes of images as well: its shadow map alone takes 64 MB.
    """

    def __init__(self, model: MjModel) -> None:
        size = model.vis.global_
        self._gl = mj.GLContext(size.offwidth, size.offheight)
        self._gl.make_current()
        self.mujoco = mj.MjrContext(model, int(mj.mjtFontScale.mjFONTSCALE_150))
        mj.mjr_setBuffer(int(mj.mjtFramebuffer.mjFB_OFFSCREEN), self.mujoco)
        self.mujoco.readDepthMap = mj.mjtDepthMap.mjDEPTH_ZEROFAR
        self._uploaded = {name: getattr(model, name).copy() for name in _UPLOADED}
        atexit.register(self.close)  # after the display was opened, so that it runs before that is closed

    def update(self, model: MjModel) -> None:
        """Make this the thread's context and bring it up to date with the model."""
        self._gl.make_current()
        size = model.vis.global_.offwidth, model.vis.global_.offheight
        if size != (self.mujoco.offWidth, self.mujoco.offHeight):
            mj.mjr_resizeOffscreen(*size, self.mujoco)
        for name, (count, upload) in _UPLOADED.items():
            now = getattr(model, name)
            if not _same(now, self._uploaded[name]):
                for i in range(getattr(model, count)):
                    getattr(mj, upload)(model, self.mujoco, i)
                self._uploaded[name][:] = now

    def close(self) -> None:
        """Let go of the graphics device."""
        atexit.unregister(self.close)
        try:
            self._gl.make_current()
        except Exception:  # each backend of MuJoCo has errors of its own: another thread did not let go of it
            _ABANDONED.append(self.mujoco)
        else:
            self.mujoco.free()
        self._gl.free()


class Overlay(Protocol):
    """A drawing over an image, such as a text."""

    def draw(self, context: MjrContext, rect: MjrRect) -> None:
        """Draw it into a part of the image."""


class Graphics:
    """Draws scenes of a model, with a context and a scene for every thread: those of OpenGL belong to threads."""

    def __init__(self, model: MjModel) -> None:
        self._model = model
        self._contexts: dict[int, _Context] = {}
        self._scenes: dict[int, MjvScene] = {}

    def scene(self) -> MjvScene:
        """Return the thread's ``MjvScene``: making one takes as long as drawing a small image without shadows."""
        thread = threading.get_ident()
        if thread not in self._scenes:
            self._scenes[thread] = new_scene(self._model)
        return self._scenes[thread]

    def draw(
        self,
        scene: MjvScene,
        size: tuple[int, int],
        overlays: Sequence[Overlay] = (),
        flags: Mapping[str | int, bool] | None = None,
        depth: bool = False,
        segmentation: bool = False,
    ) -> np.ndarray:
        """Return an image of a scene.

        Args:
            size: Height and width [pixels].
            overlays: Texts to draw over it: ``draw(context, rect)``.
            flags: Flags of ``mjtRndFlag``, by name in small letters, such as ``shadow``, or by number -> value.
            depth: Measure distances [m] instead of colours.

        Raises:
            UsageError: When there is no such flag.
        """
        wanted = {_flag(name): value for name, value in (flags or {}).items()}
        if depth or segmentation:  # distances too are drawn without light: no shadows, and no smoothing of edges
            wanted |= {_flag("segment"): True, _flag("idcolor"): True}
        # Bring the thread's context up to date.
        thread = threading.get_ident()
        if thread not in self._contexts:
            self._contexts[thread] = _Context(self._model)
        context = self._contexts[thread]
        context.update(self._model)
        rect = mj.MjrRect(0, 0, size[1], size[0])
        pixels = np.empty(size, np.float32) if depth else np.empty((*size, 3), np.uint8)
        # Draw with the flags of this image alone.
        before = scene.flags.copy()
        for flag, value in wanted.items():
            scene.flags[flag] = value
        mj.mjr_render(rect, scene, context.mujoco)
        scene.flags[:] = before
        for overlay in overlays:
            overlay.draw(context.mujoco, rect)
        # Read the pixels back, and decode distances or objects.
        mj.mjr_readPixels(None if depth else pixels, pixels if depth else None, rect, context.mujoco)
        pixels = np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest one
        if depth:
            return _distances(pixels, scene, self._model)
        return _objects(pixels, scene) if segmentation else pixels

    def close(self) -> None:
        """Let go of the graphics device."""
        while self._contexts:
            self._contexts.popitem()[1].close()
        self._scenes.clear()

    def __del__(self) -> None:
        self.close()


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two arrays are the same bits, compared eight bytes at a time."""
    first, second = (array.reshape(-1).view(np.uint8) for array in (one, other))
    whole = first.size // 8 * 8
    words = np.array_equal(first[:whole].view(np.uint64), second[:whole].view(np.uint64))
    return words and np.array_equal(first[whole:], second[whole:])


def new_scene(model: MjModel, max_geom: int | None = None) -> MjvScene:
    """Return an ``MjvScene`` of a model with room for a number of shapes; default: five for each object."""
    shown = ("body", "geom", "site", "jnt", "tendon", "u", "skin", "flex", "cam", "light")
    return mj.MjvScene(model, max_geom or max(1000, 5 * sum(getattr(model, f"n{kind}") for kind in shown)))


def _distances(pixels: np.ndarray, scene: MjvScene, model: MjModel) -> np.ndarray:
    """Return distances [m] from depths, 1 for the nearest and 0 for the farthest.

    The coefficients are rounded as those of OpenGL's projection are: near the far end that matters most.
    """
    near, far = (np.float32(x * model.stat.extent) for x in (model.vis.map.znear, model.vis.map.zfar))
    depths = pixels.astype(np.float64)
    if scene.camera[0].orthographic:
        return (far - depths * (far - near)).astype(np.float32)
    scale = np.float32(0.5) * ((far + near) / (far - near)) - np.float32(0.5)
    offset = np.float32(0.5) * (np.float32(2) * far * near / (far - near))
    return (offset / (depths + scale)).astype(np.float32)


def _objects(pixels: np.ndarray, scene: MjvScene) -> np.ndarray:
    """Return numbers and types (``mjtObj``) of objects, int32 ``(height, width, 2)``, from colours; -1 for none."""
    number = pixels.astype(np.uint32) @ np.array([1, 2**8, 2**16], np.uint32)
    table = np.full((scene.ngeom + 1, 2), -1, np.int32)
    for geom in scene.geoms[: scene.ngeom]:
        if geom.segid != -1:
            table[geom.segid + 1] = geom.objid, geom.objtype
    return table[number]


@functools.cache
def _flags() -> dict[str, int]:
    members = mj.mjtRndFlag.__members__
    return {k.removeprefix("mjRND_").lower(): int(v) for k, v in members.items() if k != "mjNRNDFLAG"}


def _flag(name: str | int) -> int:
    if not isinstance(name, str):
        return int(name)
    if name not in _flags():
        raise UsageError(f"there is no render flag {name!r}. Available: {', '.join(_flags())}")
    return _flags()[name]
