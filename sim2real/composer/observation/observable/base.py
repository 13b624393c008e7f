"""Observables: functions of the physics, attributes of elements, arrays by name, images of cameras."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.arrays import namespace
from sim2real.composer.mjcf.element import Element, as_elements
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sim2real.composer.mjcf.element import Elements
    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import Aggregate, Array, Corrupt, MjvOption, RandomState, Steps
    from sim2real.types import PyTree


class Aggregator:
    """A reduction of the buffer's first axis.

    Args:
        preserves_bounds: Whether the result lies within the bounds of the values.
    """

    def __init__(self, name: str, preserves_bounds: bool) -> None:
        self.name, self.preserves_bounds = name, preserves_bounds

    def __call__(self, values: Array) -> Array:
        """Return the reduced values; a number stays as it is."""
        if np.ndim(values) == 0:  # numpy accepts lists, jax.numpy does not
            return values
        return getattr(namespace(values), self.name)(values, axis=0)

    def __repr__(self) -> str:
        return f"Aggregator({self.name!r})"


AGGREGATORS = {name: Aggregator(name, name != "sum") for name in ("min", "max", "mean", "median", "sum")}


def _aggregator(value: str | Aggregate | None) -> Aggregate | None:
    if value is None or callable(value):
        return value
    try:
        return AGGREGATORS[value]
    except KeyError:
        names = ", ".join(AGGREGATORS)
        raise KeyError(f"Unrecognized aggregator name: {value!r}. Valid names: {names}.") from None


class Observable(ABC):
    """A quantity that an agent may see.

    Args:
        update_interval: Time steps of the physics between samples: a number, a variation or a callable; default 1.
        buffer_size: How many of the last samples an observation contains; default 1.
        delay: Time steps between sampling and arrival: a number, a variation or a callable; default 0.
        aggregator: Reduces the buffer: ``min``, ``max``, ``mean``, ``median``, ``sum`` or a callable.
        corruptor: Called as ``corruptor(value, random_state=...)`` on every sample; may be a variation.

    Attributes:
        enabled: Whether it is part of the observation; False at first.
        max_delay: Upper bound of a varying delay; compiled programs need it if the variation has no bound.
        min_interval: Lower bound of a varying interval, needed likewise.
    """

    def __init__(
        self,
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
    ) -> None:
        self.update_interval = update_interval
        self.buffer_size = buffer_size
        self.delay = delay
        self.corruptor = corruptor
        self.max_delay: int | None = None
        self.min_interval: int | None = None
        self.enabled = False
        self._aggregator = _aggregator(aggregator)

    @property
    def aggregator(self) -> Aggregate | None:
        """The reduction of the buffer, or None."""
        return self._aggregator

    @aggregator.setter
    def aggregator(self, value: str | Aggregate | None) -> None:
        self._aggregator = _aggregator(value)

    @property
    def array_spec(self) -> specs.Array | None:
        """Shape and dtype of a sample; None: found by sampling."""
        return None

    @abstractmethod
    def _callable(self, physics: BasePhysics) -> Callable[[], PyTree]:
        """Return a function that samples the raw value."""

    def observation_callable(
        self, physics: BasePhysics, random_state: RandomState | None = None
    ) -> Callable[[], PyTree]:
        """Return a function that samples the value and corrupts it."""
        sample, corruptor = self._callable(physics), self.corruptor
        if corruptor is None:
            return sample
        return lambda: corruptor(sample(), random_state=random_state)

    def __call__(self, physics: BasePhysics, random_state: RandomState | None = None) -> PyTree:
        """Return a sample."""
        return self.observation_callable(physics, random_state)()

    def configure(self, **options: PyTree) -> None:
        """Set several attributes; raise AttributeError if one does not exist."""
        for name, value in options.items():
            if not hasattr(self, name):
                raise AttributeError(f"Cannot add attribute {name} in configure.")
            setattr(self, name, value)


class Generic(Observable):
    """A function of the physics; see ``Observable`` for the options of samples.

    Args:
        raw_observation_callable: Function of the physics that returns a number or an array.
    """

    def __init__(
        self,
        raw_observation_callable: Callable[[PyTree], PyTree],
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
    ) -> None:
        self._raw_callable = raw_observation_callable
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    def _callable(self, physics: BasePhysics) -> Callable[[], PyTree]:
        return functools.partial(self._raw_callable, physics)


class MujocoFeature(Observable):
    """Rows of an array of mjData, by name; see ``Observable`` for the options of samples.

    Args:
        feature_name: Name or names of elements, or a callable that returns them.
    """

    def __init__(
        self,
        kind: str,
        feature_name: str | Sequence[str] | Callable[[], str | Sequence[str]],
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
    ) -> None:
        self._kind, self._feature_name = kind, feature_name
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    def _callable(self, physics: BasePhysics) -> Callable[[], PyTree]:
        array, name = getattr(physics.named.data, self._kind), self._feature_name
        return lambda: array[name() if callable(name) else name]


class MJCFFeature(Observable):
    """An attribute of an element, or of several of one kind; see ``Observable`` for the options of samples.

    ``feature[index]`` observes a part of it.

    Args:
        kind: The attribute's name in ``physics.bind``, such as ``qpos`` or ``xpos``.

    Raises:
        UsageError: Something is no element.
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
        as_elements(mjcf_element)  # raises an error for anything else
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
        sampling = (self.update_interval, self.buffer_size, self.delay, self.aggregator, self.corruptor)
        return MJCFFeature(self._kind, self._element, *sampling, index=key)


class MujocoCamera(Observable):
    """The image of a camera, by name: uint8 ``(height, width, 3)``, depths float32 ``(.., 1)`` [m]."""

    _segmentation = False
    scene_option: MjvOption | None = None
    _flags: Mapping[str | int, bool] | None = None

    def __init__(
        self,
        camera_name: str,
        height: int = 240,
        width: int = 320,
        update_interval: Steps = 1,
        buffer_size: Steps | None = None,
        delay: Steps | None = None,
        aggregator: str | Aggregate | None = None,
        corruptor: Corrupt | None = None,
        depth: bool = False,
    ) -> None:
        self._name, self.height, self.width, self._depth = camera_name, height, width, depth
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    @property
    def array_spec(self) -> specs.BoundedArray:
        if self._depth:
            channels, dtype, low, high = 1, np.float32, 0.0, np.inf
        elif self._segmentation:
            channels, dtype, low, high = 2, np.int32, -1, np.iinfo(np.int32).max
        else:
            channels, dtype, low, high = 3, np.uint8, 0, 255
        return specs.BoundedArray((self.height, self.width, channels), dtype, minimum=low, maximum=high)

    def _camera(self, physics: PyTree) -> str | int:
        """Return the camera's name or number."""
        return self._name

    def _callable(self, physics: PyTree) -> Callable[[], PyTree]:
        kind = {"depth": self._depth, "segmentation": self._segmentation, "scene_option": self.scene_option}
        size, flags = (self.height, self.width), self._flags
        return lambda: np.atleast_3d(physics.render(*size, self._camera(physics), **kind, render_flag_overrides=flags))


class MJCFCamera(MujocoCamera):
    """The image of a camera element; segmentations are int32 ``(height, width, 2)``: numbers and types of objects.

    Args:
        scene_option: The ``MjvOption`` of the image.
        render_flag_overrides: See ``Physics.render``.

    Raises:
        UsageError: The element is no camera, or both depth and segmentation are requested.
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
        render_flag_overrides: Mapping[str | int, bool] | None = None,
    ) -> None:
        if not isinstance(mjcf_element, Element) or mjcf_element.kind != "camera":
            raise UsageError(f"expected a <camera> element: got {mjcf_element}")
        if depth and segmentation:
            raise UsageError("`segmentation` and `depth` cannot both be `True`.")
        sampling = (update_interval, buffer_size, delay, aggregator, corruptor)
        super().__init__("", height, width, *sampling, depth)
        self._element, self._segmentation = mjcf_element, segmentation
        self.scene_option, self._flags = scene_option, render_flag_overrides

    def _camera(self, physics: PyTree) -> int:
        return physics.bind(self._element).element_id
