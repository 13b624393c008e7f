"""Sampling, delays and buffers of observables inside a compiled program; the rules are those of the ``Updater``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.observation.observable.base import Observable
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.physics.mjx.random import JaxRandomState
from sim2real.composer.variation import deterministic, distributions
from sim2real.composer.variation.base import Variation
from sim2real.errors import UsageError
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.composer.types import Steps

Call = Callable[..., PyTree]
Samples: TypeAlias = dict[str, jax.Array]
"""The samples of an observable that may still be read, when they arrive, and when the next one is taken."""


def _call(label: str, function: Call, *args: PyTree) -> PyTree:
    del label
    return function(*args)


_NEVER = np.iinfo(np.int32).max


class Ring:
    """One observable: when it is sampled, and the samples that may still be read.

    Args:
        strip: Leave the buffer's axis out when it holds one sample.
        pad_initial: Pad with the first sample rather than with zeros.

    Raises:
        UsageError: When a delay or an interval has no bound that a compiled program could reserve space for.
    """

    def __init__(
        self, name: str, observable: Observable, steps: int, strip: bool, pad_initial: bool, call: Call = _call
    ) -> None:
        self.name, self.observable, self.steps, self.pad_initial = name, observable, steps, pad_initial
        self._call = call
        size = observable.buffer_size or 1
        if callable(size):
            raise UsageError(f"observable {name!r}: on MJX the buffer size is a number, got {size!r}")
        self.size = int(size)
        self.strip = strip and self.size == 1
        self._interval = observable.update_interval or 1
        self._delay = observable.delay or 0
        shortest = self._bound(self._interval, observable.min_interval, "min_interval", 0)
        longest = self._bound(self._delay, observable.max_delay, "max_delay", 1)
        if shortest < 1 or (not callable(self._delay) and self._delay < 0):
            raise UsageError(f"observable {name!r}: intervals are at least 1 step and delays at least 0")
        self.capacity = self.size + 2 * -(-longest // shortest) + 2
        aligned = not callable(self._interval) and steps % shortest == 0
        self.direct = aligned and longest == 0 and self.size == 1
        """Whether every read falls on a sample and shows nothing but it: then there is no ring at all."""

    def _bound(self, value: Steps, declared: int | None, attribute: str, which: int) -> int:
        if not callable(value):
            return int(value)
        if declared is not None:
            return int(declared)
        bounds = _bounds(value)
        if bounds is None:
            raise UsageError(
                f"observable {self.name!r}: {value!r} has no bound, and MJX needs to know how many samples can wait",
                hint=f"set {attribute} of the observable",
            )
        return bounds[which]

    def sample(self, physics: MjxPhysics, random_state: JaxRandomState) -> jax.Array:
        """Return the corrupted value as it is now."""
        return jnp.asarray(self._call(f"observable {self.name!r}", self.observable, physics, random_state))

    def reset(self, physics: MjxPhysics, random_state: JaxRandomState) -> Samples:
        """Return the ring at the start of an episode: the first sample is in it."""
        value = self.sample(physics, random_state)
        if self.direct:
            return {"value": value}
        ring = {
            "arrival": jnp.full(self.capacity, _NEVER, jnp.int32),
            "value": jnp.zeros((self.capacity, *value.shape), value.dtype),
            "count": jnp.zeros((), jnp.int32),
            "next": jnp.zeros((), jnp.int32),
        }
        if self.pad_initial:
            ring["first"] = value
        return self._insert(ring, jnp.zeros((), jnp.int32), value, random_state)

    def update(
        self, ring: Samples, now: jax.Array, physics: MjxPhysics, random_state: JaxRandomState, counts: bool | jax.Array
    ) -> Samples:
        """Return the ring after a physics step, with a new sample in it when one is due.

        Args:
            counts: Whether a sample may be taken now. False after the last physics step of a control step: that sample
                is taken once the task's ``after_step`` hooks have run, by another call.
        """
        if self.direct:
            return {"value": self.sample(physics, random_state)}
        due = (now == ring["next"]) & counts
        taken = due & self._can_be_read(now)
        before = dict(random_state.memory)
        with physics.only_where(taken):
            value = self.sample(physics, random_state)
        new = self._insert(ring, now, value, random_state)
        for name, value_before in before.items():  # a draw that did not happen leaves no trace
            random_state.memory[name] = jnp.where(taken, random_state.memory[name], value_before)
        return jax.tree_util.tree_map(lambda a, b: jnp.where(due, a, b), new, ring)

    def _can_be_read(self, now: jax.Array) -> bool | jax.Array:
        """Return whether an observation can hold a sample taken now; the C engine does not take others either."""
        if callable(self._interval) or callable(self._delay):
            return True
        arrival = now + int(self._delay)
        read = -(-arrival // self.steps) * self.steps
        return (read - arrival) // int(self._interval) < self.size

    def _insert(self, ring: Samples, now: jax.Array, value: jax.Array, random_state: JaxRandomState) -> Samples:
        # Selected against an index: a scatter for each copy takes several kernels on a GPU, and copies the samples.
        slot = jnp.arange(self.capacity) == ring["count"] % self.capacity
        rows = jnp.reshape(slot, (self.capacity, *(1,) * value.ndim))
        return {
            **ring,
            "arrival": jnp.where(slot, now + _draw(self._delay, random_state), ring["arrival"]),
            "value": jnp.where(rows, value, ring["value"]),
            "count": ring["count"] + 1,
            "next": now + _draw(self._interval, random_state),
        }

    def read(self, ring: Samples, now: jax.Array) -> jax.Array:
        """Return the last samples that have arrived, in the order of arrival, or the result of the aggregator."""
        if self.direct:
            return self._shaped(ring["value"][None])
        order = ring["count"] - 1 - jnp.arange(self.capacity)
        slots = order % self.capacity
        there = (order >= 0) & (ring["arrival"][slots] <= now)
        by_arrival = jnp.where(there, ring["arrival"][slots], -1)
        last = jnp.lexsort((order, by_arrival))[-self.size :]
        values = ring["value"][slots[last]]
        pad = ring["first"] if self.pad_initial else jnp.zeros_like(values[0])
        shown = jnp.reshape(there[last], (self.size, *(1,) * (values.ndim - 1)))
        return self._shaped(jnp.where(shown, values, pad))

    def _shaped(self, buffer: jax.Array) -> jax.Array:
        values = buffer[0] if self.strip else buffer
        return values if self.observable.aggregator is None else self.observable.aggregator(values)


def make_rings(
    observables: Mapping[str, Observable], steps: int, strip: bool, pad_initial: bool, call: Call = _call
) -> list[Ring]:
    """Return the rings of the enabled ones of some observables.

    Args:
        observables: Key -> observable, enabled or not.
        steps: Physics steps that a control step has.
        strip: Whether a buffer of one sample has no axis of samples.
        pad_initial: Whether missing samples read as the first sample, rather than as zeros.
    """
    return [Ring(name, o, steps, strip, pad_initial, call) for name, o in observables.items() if o.enabled]


def _draw(value: Steps, random_state: JaxRandomState) -> jax.Array:
    if isinstance(value, Variation):
        value = value(random_state=random_state)
    elif callable(value):
        value = value()
    return jnp.asarray(value).astype(jnp.int32)


def _bounds(value: object) -> tuple[int, int] | None:
    """Return the least and the greatest value of a variation of integers; None if it has no bounds."""
    if isinstance(value, deterministic.Constant):
        return int(value.value), int(value.value)
    if isinstance(value, deterministic.Sequence):
        values: PyTree = value.values
        return int(min(values)), int(max(values))
    if isinstance(value, distributions.UniformInteger) and not any(map(callable, value.parameters)):
        low, high = value.parameters
        low, high = (0, low) if high is None else (low, high)
        return int(low), int(high) - 1
    if isinstance(value, distributions.UniformChoice) and not any(map(callable, value.parameters[0])):
        return int(min(value.parameters[0])), int(max(value.parameters[0]))
    return None
