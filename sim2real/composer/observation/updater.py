"""Samples of observables on the C engine; see ``schedule``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer.observation.observable.base import Observable
from sim2real.composer.observation.schedule import DEFAULT_BUFFER_SIZE as DEFAULT_BUFFER_SIZE
from sim2real.composer.observation.schedule import DEFAULT_DELAY as DEFAULT_DELAY
from sim2real.composer.observation.schedule import DEFAULT_UPDATE_INTERVAL as DEFAULT_UPDATE_INTERVAL
from sim2real.composer.observation.schedule import Schedule, draw
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import RandomState
    from sim2real.types import PyTree


def _order(sample: tuple[int, int, np.ndarray]) -> tuple[int, int]:
    return sample[:2]


class _Channel:
    """One enabled observable, and its samples that may still be read: arrival, number, value.

    Args:
        options: Options of ``Schedule``: physics steps from one observation to the next, and so on.
    """

    def __init__(
        self,
        name: str,
        observable: Observable,
        physics: BasePhysics,
        random_state: RandomState,
        options: tuple[int, bool, bool],
    ) -> None:
        size = int(draw(observable.buffer_size or DEFAULT_BUFFER_SIZE, random_state))
        self.schedule = Schedule(name, observable, *options, size)
        self._random_state = random_state
        self._gaps: dict[int, int] = {}
        self._samples: list[tuple[int, int, np.ndarray]] = []
        self._count = self.due = 0
        self._sample = observable.observation_callable(physics, random_state)
        with physics.suppress_physics_errors():
            first = np.array(self._sample())
        self.spec = observable.array_spec or specs.Array(first.shape, first.dtype)
        self._first = first.astype(self.spec.dtype, copy=False)
        self._insert(0, self._first)

    def _insert(self, now: int, value: np.ndarray) -> None:
        """Note a sample taken now, and draw when the next one is taken."""
        schedule = self.schedule
        delay: PyTree = schedule.delay
        if not schedule.is_regular:
            delay = schedule.check("delay", draw(delay, self._random_state), 0)
        self._samples.append((now + delay, self._count, value))
        self._count += 1
        if schedule.is_regular:
            self.due = now + self._gap(now)
        else:
            self.due = now + schedule.check("update interval", draw(schedule.interval, self._random_state), 1)

    def _gap(self, now: int) -> int:
        """Return the number of steps until the next sample that an observation can contain."""
        phase = now % self.schedule.steps_per_read
        if phase not in self._gaps:
            interval: PyTree = self.schedule.interval
            gap = interval
            while not self.schedule.holds(now + gap):
                gap += interval
            self._gaps[phase] = gap
        return self._gaps[phase]

    def update(self, now: int) -> None:
        """Take the sample that is due now."""
        self._insert(now, np.array(self._sample(), dtype=self.spec.dtype))

    def read(self, now: int) -> np.ndarray:
        """Return the buffer, or the result of the aggregator."""
        schedule, arrived = self.schedule, self._arrived(now)
        if len(arrived) == schedule.size == 1:
            buffer = arrived[0][2][np.newaxis].copy()
        else:
            buffer = np.zeros((schedule.size, *self._first.shape), self.spec.dtype)
            if schedule.pad_initial:
                buffer[:] = self._first
            for row, sample in enumerate(arrived, start=schedule.size - len(arrived)):
                buffer[row] = sample[2]
        return np.asarray(schedule.shaped(buffer))

    def _arrived(self, now: int) -> list[tuple[int, int, np.ndarray]]:
        """Return the samples of an observation now, in the order of their arrival; drop older ones."""
        samples = self._samples
        if not self.schedule.is_regular:
            samples.sort(key=_order)
        there = len(samples)
        while there and samples[there - 1][0] > now:
            there -= 1
        del samples[: max(0, there - self.schedule.size)]
        return samples[: min(there, self.schedule.size)]


class Updater:
    """Samples, delays and buffers observables that are enabled.

    Args:
        observables: Name -> observable, or a list or tuple of such dictionaries; observations have the same structure.
        physics_steps_per_control_step: How often ``update`` is called between reads.
        strip_singleton_buffer_dim: Whether to leave out the first axis of observations with one sample.
        pad_with_initial_value: Whether to pad with the first sample instead of zeros.

    Raises:
        UsageError: ``observables`` has another structure.
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
        self._options = physics_steps_per_control_step, strip_singleton_buffer_dim, pad_with_initial_value
        self._now = 0
        self._channels: PyTree = None
        self._flat: list[_Channel] = []

    def reset(self, physics: BasePhysics, random_state: RandomState) -> None:
        """Start an episode: take the first samples."""
        self._now = 0

        def channels(observables: dict[str, PyTree]) -> dict[str, _Channel]:
            enabled = ((name, value) for name, value in observables.items() if value.enabled)
            return type(observables)((n, _Channel(n, v, physics, random_state, self._options)) for n, v in enabled)

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
        return self._each(lambda channel: channel.read(self._now))

    def observation_spec(self) -> PyTree:
        """Return name -> ``dm_env.specs.Array``, in the structure of the observables."""
        return self._each(lambda channel: channel.schedule.spec(channel.spec))

    def _each(self, function: Callable[[_Channel], PyTree]) -> PyTree:
        self._require_reset()

        def group(channels: dict[str, _Channel]) -> dict[str, PyTree]:
            return type(channels)((name, function(channel)) for name, channel in channels.items())

        return self._map(group, self._channels)

    def _map(self, function: Callable[[PyTree], PyTree], groups: PyTree) -> PyTree:
        return type(groups)(function(g) for g in groups) if self._nested else function(groups)

    def _require_reset(self) -> None:
        if self._channels is None:
            raise RuntimeError("the updater has not been reset: call `reset` first")
