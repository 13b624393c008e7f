"""When an observable is sampled and when its samples arrive, on both engines.

Time is counted in steps of the physics from the reset. The first sample is taken at 0, each further one an interval
later. A sample arrives its delay after it is taken. An observation contains the last ``buffer_size`` samples that have
arrived, in the order of their arrival, oldest first, padded on the left.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer.observation.observable.base import Observable
from sim2real.composer.variation.base import Variation
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import RandomState, Steps
    from sim2real.types import PyTree

DEFAULT_BUFFER_SIZE = 1
DEFAULT_UPDATE_INTERVAL = 1
DEFAULT_DELAY = 0


class Schedule:
    """Options of one observable, and derived values.

    Args:
        steps_per_read: Physics steps from one observation to the next.
        strip: Whether a buffer of one sample has no axis of samples.
        pad_initial: Whether missing samples read as the first sample, rather than as zeros.

    Attributes:
        size: Samples that an observation holds.
        is_regular: Whether interval and delay are numbers.
    """

    def __init__(
        self, name: str, observable: Observable, steps_per_read: int, strip: bool, pad_initial: bool, size: int
    ) -> None:
        self.name, self.observable, self.steps_per_read = name, observable, steps_per_read
        self.size, self.strip, self.pad_initial = size, strip and size == 1, pad_initial
        self.interval: Steps = observable.update_interval or DEFAULT_UPDATE_INTERVAL
        self.delay: Steps = observable.delay or DEFAULT_DELAY
        self.is_regular = not callable(self.interval) and not callable(self.delay)
        if not callable(self.interval):
            self.interval = self.check("update interval", self.interval, 1)
        if not callable(self.delay):
            self.delay = self.check("delay", self.delay, 0)

    def check(self, what: str, value: int, least: int) -> int:
        """Return a number of steps; raise UsageError if it is too small."""
        if value < least:
            raise UsageError(f"observable {self.name!r}: the {what} must be at least {least} step, got {value}")
        return int(value)

    def holds(self, taken: PyTree) -> PyTree:
        """Return whether an observation can contain a sample taken at some step.

        Other samples are not taken, as in dm_control: a sample may compute the physics again, which would change other
        observables.
        """
        if callable(self.interval) or callable(self.delay):
            return True
        arrival = taken + self.delay
        read = -(-arrival // self.steps_per_read) * self.steps_per_read
        return (read - arrival) // self.interval < self.size  # later samples would push it out of the buffer

    def shaped(self, buffer: PyTree) -> PyTree:
        """Return the observation for a buffer ``(size, ...)``."""
        values = buffer[0] if self.strip else buffer
        return values if self.observable.aggregator is None else self.observable.aggregator(values)

    def spec(self, sample: specs.Array) -> specs.Array:
        """Return shape, dtype and perhaps bounds of an observation.

        Args:
            sample: Shape, dtype and perhaps bounds of a sample.
        """
        spec: PyTree = sample
        shape, aggregator = spec.shape if self.strip else (self.size, *spec.shape), self.observable.aggregator
        if aggregator is None:
            return spec.replace(shape=shape, name=self.name)
        value = np.asarray(aggregator(np.zeros(shape, spec.dtype)))
        if not isinstance(spec, specs.BoundedArray):
            return specs.Array(value.shape, value.dtype, name=self.name)
        if getattr(aggregator, "preserves_bounds", False):
            low, high = (np.broadcast_to(b, spec.shape) for b in (spec.minimum, spec.maximum))
            return specs.BoundedArray(value.shape, value.dtype, low, high, name=self.name)
        warnings.warn(
            f"The bounds of observable {self.name!r} are dropped: its aggregator may leave them", stacklevel=2
        )
        return specs.Array(value.shape, value.dtype, name=self.name)


def draw(value: Steps, random_state: RandomState) -> PyTree:
    """Return a number of steps, drawn if ``value`` is a variation or a function."""
    if isinstance(value, Variation):
        return value(random_state=random_state)
    return value() if callable(value) else value
