"""When observables are sampled and when their samples arrive.

Time is counted in steps of the physics from the reset. The first sample is taken at 0; each next one an interval after
the one before. A sample arrives its delay after it is taken. An observation holds the last ``buffer_size`` samples that
have arrived, in the order of their arrival, oldest first, padded on the left.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from dm_env import specs

from sim2real.composer.observation.base import Observable
from sim2real.composer.variation.base import Variation
from sim2real.errors import UsageError

DEFAULT_BUFFER_SIZE = 1
DEFAULT_UPDATE_INTERVAL = 1
DEFAULT_DELAY = 0


def _drawer(value: Any, default: int, random_state: Any) -> int | Callable[[], Any]:
    """Return an option as a number, or as a function that draws one."""
    if isinstance(value, Variation):
        return lambda: value(random_state=random_state)
    if callable(value):
        return value
    return int(value or default)


class Channel:
    """One enabled observable: its schedule and the samples that may still be read."""

    def __init__(
        self, name: str, observable: Observable, physics: Any, random_state: Any, strip: bool, pad_initial: bool
    ) -> None:
        self.name, self.observable = name, observable
        self._sample = observable.observation_callable(physics, random_state)
        self._interval = _drawer(observable.update_interval, DEFAULT_UPDATE_INTERVAL, random_state)
        self._delay = _drawer(observable.delay, DEFAULT_DELAY, random_state)
        size = _drawer(observable.buffer_size, DEFAULT_BUFFER_SIZE, random_state)
        self.size = int(size() if callable(size) else size)
        self._strip = strip and self.size == 1
        self._pad_initial = pad_initial
        # Samples that no observation can hold are left out, as in dm_control and on MJX: reading one may compute the
        # physics anew, which other observables would show.
        self._skips = not callable(self._interval) and not callable(self._delay)
        self._arrivals: list[tuple[int, int, np.ndarray]] = []
        self._count = 0
        self._next = 0
        self.spec = observable.array_spec
        with physics.suppress_physics_errors():
            first = np.array(self._sample())
        if self.spec is None:
            self.spec = specs.Array(first.shape, first.dtype)
        self._first = first.astype(self.spec.dtype, copy=False)
        self._insert(0, self._first)

    def _insert(self, now: int, value: np.ndarray) -> None:
        """Note a sample taken now, and draw when the next one is taken."""
        self._arrivals.append((now + self._draw_delay(), self._count, value))
        self._advance(now)

    def _advance(self, now: int) -> None:
        interval = int(self._interval() if callable(self._interval) else self._interval)
        if interval < 1:
            raise UsageError(f"observable {self.name!r}: the update interval must be at least 1 step, got {interval}")
        self._count += 1
        self._next = now + interval

    def _draw_delay(self) -> int:
        delay = int(self._delay() if callable(self._delay) else self._delay)
        if delay < 0:
            raise UsageError(f"observable {self.name!r}: the delay must be at least 0 steps, got {delay}")
        return delay

    def update(self, now: int, steps_per_read: int) -> None:
        """Sample, if it is time."""
        if now != self._next:
            return
        if self._skips:
            arrival = now + self._draw_delay()
            read = -(-arrival // steps_per_read) * steps_per_read
            if (read - arrival) // int(self._interval) >= self.size:  # pyright: ignore[reportArgumentType]
                self._advance(now)
                return
        self._insert(now, np.array(self._sample(), dtype=self.spec.dtype))  # pyright: ignore[reportOptionalMemberAccess]

    def read(self, now: int) -> np.ndarray:
        """Return the buffer, or what the aggregator makes of it."""
        arrived = sorted((s for s in self._arrivals if s[0] <= now), key=lambda s: s[:2])[-self.size :]
        self._arrivals = arrived + [s for s in self._arrivals if s[0] > now]
        shape, dtype = self._first.shape, self._first.dtype
        if self._strip and not self.observable.aggregator:
            if arrived:
                return arrived[0][2].copy()
            return self._first.copy() if self._pad_initial else np.zeros(shape, dtype)
        buffer = np.zeros((self.size, *shape), dtype)
        if self._pad_initial:
            buffer[:] = self._first
        for row, sample in enumerate(arrived, start=self.size - len(arrived)):
            buffer[row] = sample[2]
        aggregator = self.observable.aggregator
        if aggregator is None:
            return buffer
        return np.asarray(aggregator(buffer[0] if self._strip else buffer))

    def observation_spec(self) -> specs.Array:
        """Return what ``read`` returns: shape, dtype, and bounds where they are known."""
        spec: Any = self.spec
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
        observables: Any,
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
        self._channels: Any = None
        self._flat: list[Channel] = []

    def reset(self, physics: Any, random_state: Any) -> None:
        """Start an episode: take the first samples."""
        self._now = 0

        def channels(observables: dict[str, Any]) -> dict[str, Channel]:
            made = type(observables)()
            for name, value in observables.items():
                if value.enabled:
                    made[name] = Channel(name, value, physics, random_state, self._strip, self._pad_initial)
            return made

        self._channels = self._map(channels, self._observables)
        self._flat = [c for group in (self._channels if self._nested else (self._channels,)) for c in group.values()]

    def prepare_for_next_control_step(self) -> None:
        """Check that an episode has been started; the schedule needs no preparation."""
        self._require_reset()

    def update(self) -> None:
        """Count a step of the physics, and take the samples that are due."""
        self._require_reset()
        self._now += 1
        for channel in self._flat:
            channel.update(self._now, self._steps_per_read)

    def get_observation(self) -> Any:
        """Return name -> array, in the structure of the observables."""
        self._require_reset()
        return self._each(lambda channel: channel.read(self._now))

    def observation_spec(self) -> Any:
        """Return name -> ``dm_env.specs.Array``, in the structure of the observables."""
        self._require_reset()
        return self._each(lambda channel: channel.observation_spec())

    def _each(self, function: Callable[[Channel], Any]) -> Any:
        def group(channels: dict[str, Channel]) -> dict[str, Any]:
            return type(channels)((name, function(channel)) for name, channel in channels.items())

        return self._map(group, self._channels)

    def _map(self, function: Callable[[Any], Any], groups: Any) -> Any:
        return type(groups)(function(g) for g in groups) if self._nested else function(groups)

    def _require_reset(self) -> None:
        if self._channels is None:
            raise RuntimeError("the updater has not been reset: call `reset` first")
