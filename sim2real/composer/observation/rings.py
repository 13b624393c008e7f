"""Samples of observables in compiled programs; see ``composer.observation.schedule``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.observation.observable.base import Observable
from sim2real.composer.observation.schedule import Schedule, draw
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.physics.mjx.random import JaxRandomState
from sim2real.composer.variation import deterministic, distributions
from sim2real.errors import UsageError
from sim2real.types import PyTree

Call = Callable[..., PyTree]
Samples: TypeAlias = dict[str, jax.Array]
"""The samples of an observable that may still be read, when they arrive, and when the next one is taken."""
_NEVER = np.iinfo(np.int32).max


class Ring:
    """One observable with its samples that may still be read, in arrays of fixed size.

    Args:
        options: Options of ``Schedule``: physics steps from one observation to the next, and so on.
        call: Calls the observable, given a label and the arguments.

    Raises:
        UsageError: A delay or an interval has no bound, so that a compiled program cannot reserve space.

    Attributes:
        direct: Whether every read returns the sample of the same time: then there is no ring.
    """

    def __init__(self, name: str, observable: Observable, options: tuple[int, bool, bool], call: Call) -> None:
        size = observable.buffer_size or 1
        if callable(size):
            raise UsageError(f"observable {name!r}: on MJX the buffer size is a number, got {size!r}")
        self.name, self._call = name, call
        self._schedule = schedule = Schedule(name, observable, *options, int(size))
        shortest = schedule.check("update interval", self._bound("min_interval", schedule.interval, 0), 1)
        longest = self._bound("max_delay", schedule.delay, 1)
        self._capacity = schedule.size + 2 * -(-longest // shortest) + 2
        aligned = not callable(schedule.interval) and schedule.steps_per_read % shortest == 0
        self.direct = aligned and longest == 0 and schedule.size == 1

    def _bound(self, attribute: str, value: object, which: int) -> int:
        declared = getattr(self._schedule.observable, attribute)
        bounds = (declared, declared) if declared is not None and callable(value) else _bounds(value)
        if bounds is None:
            raise UsageError(
                f"observable {self.name!r}: {value!r} has no bound, and MJX needs to know how many samples can wait",
                hint=f"set {attribute} of the observable",
            )
        return int(bounds[which])

    def sample(self, physics: MjxPhysics, random_state: JaxRandomState) -> jax.Array:
        """Return the corrupted value as it is now."""
        observable = self._schedule.observable
        return jnp.asarray(self._call(f"observable {self.name!r}", observable, physics, random_state))

    def reset(self, physics: MjxPhysics, random_state: JaxRandomState) -> Samples:
        """Return the ring at the start of an episode: the first sample is in it."""
        value = self.sample(physics, random_state)
        if self.direct:
            return {"value": value}
        ring = {
            "arrival": jnp.full(self._capacity, _NEVER, jnp.int32),
            "value": jnp.zeros((self._capacity, *value.shape), value.dtype),
            "count": jnp.zeros((), jnp.int32),
            "next": jnp.zeros((), jnp.int32),
        }
        if self._schedule.pad_initial:
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
        taken = due & self._schedule.holds(now)
        before = dict(random_state.memory)
        with physics.only_where(taken):
            value = self.sample(physics, random_state)
        new = self._insert(ring, now, value, random_state)
        for name, value_before in before.items():  # a draw that did not happen must not change the state
            random_state.memory[name] = jnp.where(taken, random_state.memory[name], value_before)
        return jax.tree_util.tree_map(lambda a, b: jnp.where(due, a, b), new, ring)

    def _insert(self, ring: Samples, now: jax.Array, value: jax.Array, random_state: JaxRandomState) -> Samples:
        # Select by comparing indices: a scatter for each copy takes several kernels on a GPU, and copies the samples.
        slot = jnp.arange(self._capacity) == ring["count"] % self._capacity
        rows = jnp.reshape(slot, (self._capacity, *(1,) * value.ndim))
        delay, interval = (
            jnp.asarray(draw(steps, random_state)).astype(jnp.int32)
            for steps in (self._schedule.delay, self._schedule.interval)
        )
        return {
            **ring,
            "arrival": jnp.where(slot, now + delay, ring["arrival"]),
            "value": jnp.where(rows, value, ring["value"]),
            "count": ring["count"] + 1,
            "next": now + interval,
        }

    def read(self, ring: Samples, now: jax.Array) -> jax.Array:
        """Return the last samples that have arrived, in the order of arrival, or the result of the aggregator."""
        schedule = self._schedule
        if self.direct:
            return schedule.shaped(ring["value"][None])
        order = ring["count"] - 1 - jnp.arange(self._capacity)
        slots = order % self._capacity
        there = (order >= 0) & (ring["arrival"][slots] <= now)
        by_arrival = jnp.where(there, ring["arrival"][slots], -1)
        last = jnp.lexsort((order, by_arrival))[-schedule.size :]
        values = ring["value"][slots[last]]
        pad = ring["first"] if schedule.pad_initial else jnp.zeros_like(values[0])
        shown = jnp.reshape(there[last], (schedule.size, *(1,) * (values.ndim - 1)))
        return schedule.shaped(jnp.where(shown, values, pad))


def _bounds(value: object) -> tuple[int, int] | None:
    """Return the smallest and largest value of a number or an integer variation; None without bounds."""
    if not callable(value):
        return int(value), int(value)  # pyright: ignore[reportArgumentType]
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
