"""When observables are sampled and when their samples arrive.

Time is counted in steps of the physics from the reset. The first sample is taken at 0; each next one an interval after
the one before. A sample arrives its delay after it is taken. An observation holds the last ``buffer_size`` samples that
have arrived, in the order of their arrival, oldest first, padded on the left.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer.observation.observable.base import Observable
from sim2real.composer.variation.base import Variation
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import RandomState, Steps
    from sim2real.types import PyTree

DEFAULT_BUFFER_SIZE = 1
DEFAULT_UPDATE_INTERVAL = 1
DEFAULT_DELAY = 0


def _drawer(value: Steps | None, default: int, random_state: RandomState) -> int | Callable[[], int]:
    """Return an option as a number, or as a function that draws one."""
    if isinstance(value, Variation):
        return lambda: value(random_state=random_state)
    if callable(value):
        return value
    return int(value or default)


def _order(sample: tuple[int, int, np.ndarray]) -> tuple[int, int]:
    return sample[:2]


class _Channel:
    """One enabled observable: its schedule and the samples that may still be read.

    Args:
        steps_per_read: Physics steps from one observation to the next.
        strip: Whether a buffer of one sample has no axis of samples.
        pad_initial: Whether missing samples read as the first sample, rather than as zeros.
    """

    def __init__(
        self,
        name: str,
        observable: Observable,
        physics: BasePhysics,
        random_state: RandomState,
        steps_per_read: int,
        strip: bool,
        pad_initial: bool,
    ) -> None:
        self.name, self.observable = name, observable
        self._sample = observable.observation_callable(physics, random_state)
        self._interval = _drawer(observable.update_interval, DEFAULT_UPDATE_INTERVAL, random_state)
        self._delay = _drawer(observable.delay, DEFAULT_DELAY, random_state)
        size = _drawer(observable.buffer_size, DEFAULT_BUFFER_SIZE, random_state)
        self.size = int(size() if callable(size) else size)
        self._strip = strip and self.size == 1
        self._pad_initial = pad_initial
        # Samples that no observation can hold are not taken, as in dm_control and on MJX: reading one may compute the
        # physics again, which would change other observables.
        self._is_regular = not callable(self._interval) and not callable(self._delay)
        self._gaps: dict[int, tuple[int, int]] = {}
        self._steps_per_read = steps_per_read
        self._arrivals: list[tuple[int, int, np.ndarray]] = []
        self._count = 0
        self.due = 0
        self.spec = observable.array_spec
        with physics.suppress_physics_errors():
            first = np.array(self._sample())
        if self.spec is None:
            self.spec = specs.Array(first.shape, first.dtype)
        self._dtype = self.spec.dtype
        self._first = first.astype(self._dtype, copy=False)
        self._insert(0, self._first)

    def _insert(self, now: int, value: np.ndarray) -> None:
        """Note a sample taken now, and draw when the next one is taken."""
        self._arrivals.append((now + self._draw_delay(), self._count, value))
        if self._is_regular:
            taken, step = self._until_read(now)
            self._count += taken
            self.due = now + step
            return
        self._count += 1
        self.due = now + self._draw_interval()

    def _until_read(self, now: int) -> tuple[int, int]:
        """Return how many samples later the next one comes that an observation holds, and how many steps later."""
        gap = self._gaps.get(now % self._steps_per_read)
        if gap is None:
            interval, taken = self._draw_interval(), 1
            while self._is_unread(now + taken * interval, interval):
                taken += 1
            gap = self._gaps[now % self._steps_per_read] = taken, taken * interval
        return gap

    def _is_unread(self, taken: int, interval: int) -> bool:
        """Return whether later samples push a sample out of the buffer before the next read."""
        arrival = taken + self._draw_delay()
        read = -(-arrival // self._steps_per_read) * self._steps_per_read
        return (read - arrival) // interval >= self.size

    def _draw_interval(self) -> int:
        interval = int(self._interval() if callable(self._interval) else self._interval)
        if interval < 1:
            raise UsageError(f"observable {self.name!r}: the update interval must be at least 1 step, got {interval}")
        return interval

    def _draw_delay(self) -> int:
        delay = int(self._delay() if callable(self._delay) else self._delay)
        if delay < 0:
            raise UsageError(f"observable {self.name!r}: the delay must be at least 0 steps, got {delay}")
        return delay

    def update(self, now: int) -> None:
        """Take the sample that is due now."""
        self._insert(now, np.array(self._sample(), dtype=self._dtype))

    def read(self, now: int) -> np.ndarray:
        """Return the buffer, or the result of the aggregator."""
        arrived = self._arrived(now)
        if self._strip and not self.observable.aggregator:
            if arrived:
                return arrived[0][2].copy()
            return self._first.copy() if self._pad_initial else np.zeros(self._first.shape, self._dtype)
        if len(arrived) == self.size == 1:
            buffer = arrived[0][2][np.newaxis].copy()
        else:
            buffer = np.zeros((self.size, *self._first.shape), self._dtype)
            if self._pad_initial:
                buffer[:] = self._first
            for row, sample in enumerate(arrived, start=self.size - len(arrived)):
                buffer[row] = sample[2]
        aggregator = self.observable.aggregator
        if aggregator is None:
            return buffer
        return np.asarray(aggregator(buffer[0] if self._strip else buffer))

    def _arrived(self, now: int) -> list[tuple[int, int, np.ndarray]]:
        """Return the samples that an observation holds now, in the order of their arrival; forget those before."""
        samples = self._arrivals
        if not self._is_regular:
            samples.sort(key=_order)
        there = len(samples)
        while there and samples[there - 1][0] > now:
            there -= 1
        del samples[: max(0, there - self.size)]
        return samples[: min(there, self.size)]

    def observation_spec(self) -> specs.Array:
        """Return the spec of ``read``: shape, dtype, and bounds where the observable has some."""
        spec: PyTree = self.spec
        aggregator = self.observable.aggregator
        shape = spec.shape if self._strip else (self.size, *spec.shape)
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


class Updater:
    """Samples, delays and buffers the enabled ones of some observables.

    Args:
        observables: Name -> observable, or a list or tuple of such dictionaries; observations have that structure.
        physics_steps_per_control_step: How often ``update`` is called between reads.
        strip_singleton_buffer_dim: Leave the first axis out where the buffer holds one sample.
        pad_with_initial_value: Pad with the first sample rather than with zeros.

    Raises:
        UsageError: When ``observables`` has another structure.
    """

    def __init__(
        self,
        observables: Mapping[str, Observable] | Sequence[Mapping[str, Observable]],
        physics_steps_per_control_step: int = 1,
        strip_singleton_buffer_dim: bool = False,
        pad_with_initial_value: bool = False,
    ) -> None:
        nested = isinstance(observables, list | tuple)
        if not all(isinstance(o, dict) for o in (observables if nested else (observables,))):
            raise UsageError(f"`observables` should be a dict, or a (list or tuple) of dicts: got {observables}")
        self._observables, self._nested = observables, nested
        self._steps_per_read = physics_steps_per_control_step
        self._strip, self._pad_initial = strip_singleton_buffer_dim, pad_with_initial_value
        self._now = 0
        self._channels: PyTree = None
        self._flat: list[_Channel] = []

    def reset(self, physics: BasePhysics, random_state: RandomState) -> None:
        """Start an episode: take the first samples."""
        self._now = 0

        def channels(observables: dict[str, PyTree]) -> dict[str, _Channel]:
            channels_by_name = type(observables)()
            for name, value in observables.items():
                if value.enabled:
                    options = (self._steps_per_read, self._strip, self._pad_initial)
                    channels_by_name[name] = _Channel(name, value, physics, random_state, *options)
            return channels_by_name

        self._channels = self._map(channels, self._observables)
        self._flat = [c for group in (self._channels if self._nested else (self._channels,)) for c in group.values()]

    def prepare_for_next_control_step(self) -> None:
        """Check that an episode has been started; the schedule needs no preparation."""
        self._require_reset()

    def update(self) -> None:
        """Count a step of the physics, and take the samples that are due."""
        if self._channels is None:
            self._require_reset()
        self._now += 1
        now = self._now
        for channel in self._flat:
            if channel.due == now:
                channel.update(now)

    def get_observation(self) -> PyTree:
        """Return name -> array, in the structure of the observables."""
        self._require_reset()
        return self._each(lambda channel: channel.read(self._now))

    def observation_spec(self) -> PyTree:
        """Return name -> ``dm_env.specs.Array``, in the structure of the observables."""
        self._require_reset()
        return self._each(lambda channel: channel.observation_spec())

    def _each(self, function: Callable[[_Channel], PyTree]) -> PyTree:
        def group(channels: dict[str, _Channel]) -> dict[str, PyTree]:
            return type(channels)((name, function(channel)) for name, channel in channels.items())

        return self._map(group, self._channels)

    def _map(self, function: Callable[[PyTree], PyTree], groups: PyTree) -> PyTree:
        return type(groups)(function(g) for g in groups) if self._nested else function(groups)

    def _require_reset(self) -> None:
        if self._channels is None:
            raise RuntimeError("the updater has not been reset: call `reset` first")
