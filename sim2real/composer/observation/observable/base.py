"""What can be observed: a function of the physics, a MuJoCo array by name, a camera by name."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer.physics.arrays import namespace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import Aggregate, Array, Corrupt, RandomState, Steps
    from sim2real.types import PyTree


class Aggregator:
    """A reduction of the buffer's first axis.

    Args:
        preserves_bounds: Whether the result lies within the bounds of the values.
    """

    def __init__(self, name: str, preserves_bounds: bool) -> None:
        self.name, self.preserves_bounds = name, preserves_bounds

    def __call__(self, values: Array) -> Array:
        """Return the reduced values; a number without an axis stays as it is."""
        if np.ndim(values) == 0:  # as numpy does, and jax.numpy does not
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
        buffer_size: How many of the last samples an observation holds; default 1.
        delay: Time steps between sampling and arrival: a number, a variation or a callable; default 0.
        aggregator: Reduces the buffer: ``min``, ``max``, ``mean``, ``median``, ``sum`` or a callable.
        corruptor: Called as ``corruptor(value, random_state=...)`` on every sample; may be a variation.

    Attributes:
        enabled: Whether it is part of the observation; False at first.
        max_delay: Bound of a delay that varies; compiled programs need it where the variation has none of its own.
        min_interval: Bound of an interval that varies; the same.
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
        """Set several attributes; AttributeError when there is none of a name."""
        for name, value in options.items():
            if not hasattr(self, name):
                raise AttributeError(f"Cannot add attribute {name} in configure.")
            setattr(self, name, value)


class Generic(Observable):
    """A function of the physics.

    Args:
        raw_observation_callable: Takes the physics, returns a number or an array.
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
    """Rows of an array of mjData, by name.

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


class MujocoCamera(Observable):
    """The image of a camera, by name; uint8 ``(height, width, 3)``, or float32 ``(height, width, 1)`` [m] for depth."""

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
        self._camera_name, self.height, self.width, self._depth = camera_name, height, width, depth
        super().__init__(update_interval, buffer_size, delay, aggregator, corruptor)

    @property
    def array_spec(self) -> specs.Array:
        """Shape and dtype of the image."""
        shape = (self.height, self.width, 1 if self._depth else 3)
        return specs.Array(shape, np.float32 if self._depth else np.uint8)

    def _callable(self, physics: PyTree) -> Callable[[], PyTree]:
        def image() -> np.ndarray:
            pixels = physics.render(self.height, self.width, self._camera_name, depth=self._depth)
            return np.atleast_3d(pixels)

        return image
