"""Observables of elements: attributes of joints, bodies, sensors and so on, and images of cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer.mjcf.element import Element
from sim2real.composer.observation.observable.base import Observable
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Elements
    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import Aggregate, Corrupt, MjvOption, Steps
    from sim2real.types import PyTree


def _check_elements(elements: Elements) -> None:
    for element in (elements,) if isinstance(elements, Element) or not isinstance(elements, Iterable) else elements:
        if not isinstance(element, Element):
            raise UsageError(f"expected an `mjcf.Element`, got type {type(element)}: {element}")


class MJCFFeature(Observable):
    """An attribute of an element, or of several of one kind, as ``physics.bind`` names it.

    ``feature[index]`` observes a part of it.

    Args:
        kind: The attribute, such as ``qpos`` or ``xpos``.

    Raises:
        UsageError: When something given is no element.
    """

    def __init__(
        self,
        kind: str,
        mjcf_element: Elements,
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
        index: PyTree = None,
    ) -> None:
        _check_elements(mjcf_element)
        self._kind, self._element, self._index = kind, mjcf_element, index
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    def _callable(self, physics: BasePhysics) -> Callable[[], PyTree]:
        binding, kind, index = physics.bind(self._element), self._kind, self._index
        if index is None:
            return lambda: getattr(binding, kind)
        index = np.asarray(index) if isinstance(index, list) else index
        return lambda: getattr(binding, kind)[index]

    def __getitem__(self, key: PyTree) -> MJCFFeature:
        if self._index is not None:
            raise NotImplementedError("slicing an already-sliced MJCFFeature observable is not supported")
        options = (self.update_interval, self.buffer_size, self.delay, self.aggregator, self.corruptor)
        return MJCFFeature(self._kind, self._element, *options, key)


class MJCFCamera(Observable):
    """An image: uint8 ``(height, width, 3)``, depth float32 ``(.., 1)`` [m] or segmentation int32 ``(.., 2)``.

    Args:
        scene_option: The ``MjvOption`` of the image.

    Raises:
        UsageError: When the element is no camera, or depth and segmentation are both asked for.
    """

    def __init__(
        self,
        mjcf_element: Element,
        height: int = 240,
        width: int = 320,
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
        depth: bool = False,
        segmentation: bool = False,
        scene_option: MjvOption | None = None,
    ) -> None:
        if not isinstance(mjcf_element, Element):
            raise UsageError(f"expected an `mjcf.Element`, got type {type(mjcf_element)}: {mjcf_element}")
        if mjcf_element.kind != "camera":
            raise UsageError(f"expected a <camera> element: got {mjcf_element}")
        if depth and segmentation:
            raise UsageError("`segmentation` and `depth` cannot both be `True`.")
        self._element, self.height, self.width = mjcf_element, height, width
        self._depth, self._segmentation, self.scene_option = depth, segmentation, scene_option
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    @property
    def array_spec(self) -> specs.BoundedArray:
        """Shape, dtype and bounds of the image."""
        if self._depth:
            channels, dtype, low, high = 1, np.float32, 0.0, np.inf
        elif self._segmentation:
            channels, dtype, low, high = 2, np.int32, -1, np.iinfo(np.int32).max
        else:
            channels, dtype, low, high = 3, np.uint8, 0, 255
        return specs.BoundedArray((self.height, self.width, channels), dtype, minimum=low, maximum=high)

    def _callable(self, physics: PyTree) -> Callable[[], PyTree]:
        def image() -> np.ndarray:
            pixels = physics.render(
                self.height,
                self.width,
                physics.bind(self._element).element_id,
                depth=self._depth,
                segmentation=self._segmentation,
                scene_option=self.scene_option,
            )
            return np.atleast_3d(pixels)

        return image
