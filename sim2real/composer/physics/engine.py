"""Cameras of a physics, and texts over their images, under the names of ``dm_control.mujoco.engine``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics.c.rendering import Graphics, new_scene
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.physics.c.views import DataView, ModelView
    from sim2real.composer.types import ArrayLike, MjrContext, MjrRect, MjvOption, MjvScene

_FONTS = {name: getattr(mj.mjtFont, f"mjFONT_{name.upper()}") for name in ("normal", "shadow", "big")}
_PLACES = {
    name: getattr(mj.mjtGridPos, f"mjGRID_{name.replace(' ', '').upper()}")
    for name in ("top left", "top right", "bottom left", "bottom right")
}


class Scenery(Protocol):
    """A ``Physics``, for cameras."""

    model: ModelView
    data: DataView
    graphics: Graphics


class CameraMatrices(NamedTuple):
    """Factors of a camera's matrix, which is their product."""

    image: np.ndarray
    """Shape ``(3, 3)``: the centre of the image [pixels]."""
    focal: np.ndarray
    """Shape ``(3, 4)``: the focal length [pixels]."""
    rotation: np.ndarray
    """Shape ``(4, 4)``."""
    translation: np.ndarray
    """Shape ``(4, 4)`` [m]."""


class Pose(NamedTuple):
    """Where a movable camera is."""

    lookat: np.ndarray
    """The point in the middle of the image, shape ``(3,)`` [m]."""
    distance: float
    """From that point [m]."""
    azimuth: float
    """[degrees]."""
    elevation: float
    """[degrees]."""


class Selected(NamedTuple):
    """The object at a place of an image: numbers or None, and its position, shape ``(3,)`` [m]."""

    body: int | None
    geom: int | None
    flex: int | None
    skin: int | None
    world_position: np.ndarray | None


class Camera:
    """A view of a physics.

    Args:
        height: Pixels, at most the model's ``visual/global/offheight``.
        width: Pixels, at most the model's ``visual/global/offwidth``.
        camera_id: Number or name of one of the model's cameras; -1 is the free camera.
        max_geom: The most shapes to draw; default: what the model can show.
        scene_callback: Called with the physics and the ``MjvScene`` before it is drawn, to add shapes.
        scene: The ``MjvScene`` to fill, with what ``max_geom`` it has; default: one of its own.

    Raises:
        UsageError: When the image is larger than the model's buffer, or there is no such camera.
    """

    def __init__(
        self,
        physics: Scenery,
        height: int = 240,
        width: int = 320,
        camera_id: int | str = -1,
        max_geom: int | None = None,
        scene_callback: Callable[[Any, MjvScene], None] | None = None,
        scene: MjvScene | None = None,
    ) -> None:
        model = physics.model.ptr
        for name, size in (("width", width), ("height", height)):
            most = getattr(model.vis.global_, f"off{name}")
            if size > most:
                raise UsageError(
                    f"Image {name} {size} > framebuffer {name} {most}",
                    hint=f'a smaller image, or `<visual><global off{name}="{size}"/></visual>` in the model',
                )
        if isinstance(camera_id, str):
            camera_id = int(physics.model.name2id(camera_id, "camera"))
        if camera_id < -1:
            raise UsageError("camera_id cannot be smaller than -1.")
        if camera_id >= model.ncam:
            raise UsageError(f"model has {model.ncam} fixed cameras. camera_id={camera_id} is invalid.")
        self._physics, self._size, self._callback, self._max_geom = physics, (height, width), scene_callback, max_geom
        self._model, self._scene, self._option = model, scene or new_scene(model, max_geom), mj.MjvOption()
        self._camera = mj.MjvCamera()
        self._camera.fixedcamid = camera_id
        if camera_id == -1:
            mj.mjv_defaultFreeCamera(model, self._camera)
        else:
            self._camera.type = mj.mjtCamera.mjCAMERA_FIXED

    @property
    def height(self) -> int:
        """Height of the image [pixels]."""
        return self._size[0]

    @property
    def width(self) -> int:
        """Width of the image [pixels]."""
        return self._size[1]

    @property
    def option(self) -> MjvOption:
        """The ``MjvOption`` of the images, to be changed in place."""
        return self._option

    @property
    def scene(self) -> MjvScene:
        """The ``MjvScene``."""
        return self._scene

    @property
    def matrix(self) -> np.ndarray:
        """The matrix that takes points of the world to the image, shape ``(3, 4)``.

        ``x, y, scale = matrix @ [*point, 1]`` puts a point [m] at column ``x / scale`` and row ``y / scale``.
        """
        image, focal, rotation, translation = self.matrices()
        return image @ focal @ rotation @ translation

    def matrices(self) -> CameraMatrices:
        """Return the factors of ``matrix``."""
        number, model, data = self._camera.fixedcamid, self._physics.model.ptr, self._physics.data.ptr
        if number == -1:  # only the scene has the pose of the free camera: between its two eyes
            self.update()
            position, forward, up = (
                np.mean([getattr(eye, name) for eye in self._scene.camera], axis=0) for name in ("pos", "forward", "up")
            )
            axes, angle = np.vstack([np.cross(up, -forward), up, -forward]), model.vis.global_.fovy
        else:
            position, axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3).T
            angle = model.cam_fovy[number]
        length = 1.0 / np.tan(np.deg2rad(angle) / 2) * self.height / 2
        image, rotation, translation = np.eye(3), np.eye(4), np.eye(4)
        image[:2, 2] = (self.width - 1) / 2, (self.height - 1) / 2
        rotation[:3, :3] = axes
        translation[:3, 3] = -position
        return CameraMatrices(image, np.diag([-length, length, 1.0, 0.0])[:3], rotation, translation)

    def update(self, scene_option: MjvOption | None = None) -> None:
        """Fill the scene with what the physics looks like now.

        Args:
            scene_option: The ``MjvOption`` of the image; default: ``option``.
        """
        model = self._physics.model.ptr
        if model is not self._model:  # compiled again since then
            self._model, self._scene = model, new_scene(model, self._max_geom)
        option = self._option if scene_option is None else getattr(scene_option, "ptr", scene_option)
        everything = int(mj.mjtCatBit.mjCAT_ALL)
        mj.mjv_updateScene(model, self._physics.data.ptr, option, None, self._camera, everything, self._scene)

    def render(
        self,
        overlays: Sequence[TextOverlay] = (),
        depth: bool = False,
        segmentation: bool = False,
        scene_option: MjvOption | None = None,
        render_flag_overrides: Mapping[str | int, bool] | None = None,
    ) -> np.ndarray:
        """Return an image: uint8 ``(height, width, 3)``; float32 ``(height, width)`` [m]; int32 ``(.., .., 2)``.

        Args:
            segmentation: Return numbers and types (``mjtObj``) of objects instead; (-1, -1) is none.
            scene_option: The ``MjvOption`` of the image; default: ``option``.
            render_flag_overrides: Flags of ``mjtRndFlag``, by name in small letters, such as ``shadow``, or by
                number -> value, for this image.
        """
        if overlays and (depth or segmentation):
            raise UsageError("Overlays are not supported with depth or segmentation rendering.")
        if render_flag_overrides and (depth or segmentation):
            raise UsageError("`render_flag_overrides` are not supported for depth or segmentation rendering.")
        if depth and segmentation:
            raise UsageError("`segmentation` and `depth` cannot both be `True`.")
        self.update(scene_option)
        if self._callback:
            self._callback(self._physics, self._scene)
        draw = self._physics.graphics.draw
        return draw(self._scene, self._size, overlays, render_flag_overrides, depth, segmentation)

    def select(self, cursor_position: tuple[float, float]) -> Selected:
        """Return the object at a place of the image.

        Args:
            cursor_position: From 0 to 1 to the right, and from 0 to 1 upwards.
        """
        self.update()
        position, (geom, flex, skin) = np.zeros(3), (np.full(1, -1, np.intc) for _ in range(3))
        model, data, aspect = self._model, self._physics.data.ptr, self.width / self.height
        body = mj.mjv_select(
            model, data, self._option, aspect, *cursor_position, self._scene, position, geom, flex, skin
        )
        numbers = [None if i == -1 else int(i) for i in (body, geom[0], flex[0], skin[0])]
        return Selected(*numbers, world_position=None if all(i is None for i in numbers) else position)


class MovableCamera(Camera):
    """A free camera that can be put anywhere."""

    def __init__(
        self,
        physics: Scenery,
        height: int = 240,
        width: int = 320,
        max_geom: int | None = None,
        scene_callback: Callable[[Any, MjvScene], None] | None = None,
    ) -> None:
        super().__init__(physics, height, width, -1, max_geom, scene_callback)

    def get_pose(self) -> Pose:
        """Return where the camera is."""
        camera = self._camera
        return Pose(camera.lookat.copy(), camera.distance, camera.azimuth, camera.elevation)

    def set_pose(self, lookat: ArrayLike, distance: float, azimuth: float, elevation: float) -> None:
        """Put the camera somewhere; see ``Pose``.

        Args:
            lookat: The point in the middle of the image, shape ``(3,)`` [m].
            distance: From that point [m].
            azimuth: [degrees].
            elevation: [degrees].
        """
        self._camera.lookat[:] = lookat
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, elevation


class TextOverlay:
    """A text over an image, in two columns.

    Args:
        style: ``'normal'``, ``'shadow'`` or ``'big'``.
        position: ``'top left'``, ``'top right'``, ``'bottom left'`` or ``'bottom right'``.

    Raises:
        UsageError: When there is no such style or position.
    """

    def __init__(self, title: str = "", body: str = "", style: str = "normal", position: str = "top left") -> None:
        for name, choices in ((style, _FONTS), (position, _PLACES)):
            if name not in choices:
                raise UsageError(f"texts have no style or position {name!r}. Available: {', '.join(choices)}")
        self.title, self.body, self.style, self.position = title, body, _FONTS[style], _PLACES[position]

    def draw(self, context: MjrContext, rect: MjrRect) -> None:
        """Draw it with an ``MjrContext`` into an ``MjrRect``."""
        mj.mjr_overlay(self.style, self.position, rect, self.title, self.body, context)
