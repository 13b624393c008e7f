"""When samples are taken and when they arrive, against a direct transcription of the nominal schedule."""

import contextlib

import numpy as np
import pytest
from dm_env import specs
from hypothesis import given
from hypothesis import strategies as st

from sim2real.composer.observation.observable import Generic
from sim2real.composer.observation.updater import Updater
from sim2real.composer.variation import deterministic
from sim2real.errors import UsageError


class Clock:
    """A physics that only counts its steps."""

    def __init__(self):
        self.steps = 0

    def suppress_physics_errors(self):
        return contextlib.nullcontext()


def observe(observables, steps, reads, **options):
    """Return the observations at the ends of ``reads`` control steps of ``steps`` steps."""
    for value in observables.values():
        value.enabled = True
    clock, updater, found = Clock(), Updater(observables, steps, **options), []
    updater.reset(clock, np.random.RandomState(0))
    found.append(updater.get_observation())
    for _ in range(reads):
        updater.prepare_for_next_control_step()
        for _ in range(steps):
            clock.steps += 1
            updater.update()
        found.append(updater.get_observation())
    return found


def nominal(intervals, delays, size, steps, reads):
    """Return the same, written down as the rules say."""
    taken, now = [], 0
    i, d = 0, 0
    while now <= steps * reads:
        taken.append((now + delays[d % len(delays)], len(taken), now))
        now += intervals[i % len(intervals)]
        i, d = i + 1, d + 1
    rows = []
    for read in range(reads + 1):
        arrived = sorted(s for s in taken if s[0] <= read * steps and s[2] <= read * steps)[-size:]
        rows.append([0] * (size - len(arrived)) + [s[2] + 1 for s in arrived])
    return rows


@given(
    intervals=st.lists(st.integers(1, 7), min_size=1, max_size=4),
    delays=st.lists(st.integers(0, 9), min_size=1, max_size=4),
    size=st.integers(1, 4),
    steps=st.integers(1, 6),
)
def test_the_schedule_is_the_nominal_one(intervals, delays, size, steps):
    sequence = deterministic.Sequence
    interval = intervals[0] if len(intervals) == 1 else sequence(intervals)
    delay = delays[0] if len(delays) == 1 else sequence(delays)
    value = Generic(lambda clock: clock.steps + 1, update_interval=interval, delay=delay, buffer_size=size)
    found = observe({"value": value}, steps, 6)
    assert [f["value"].tolist() for f in found] == nominal(intervals, delays, size, steps, 6)


def test_samples_that_nobody_can_read_are_not_taken():
    seen = []
    value = Generic(lambda clock: seen.append(clock.steps) or clock.steps)
    observe({"x": value}, 25, 2)
    assert seen == [0, 25, 50]


class Bounded(Generic):
    array_spec = specs.BoundedArray((2,), float, 1, 4)


def test_specs_keep_bounds_that_the_aggregator_keeps():
    def spec(aggregator):
        value = Bounded(lambda clock: [2.0, 2.0], buffer_size=3, aggregator=aggregator)
        value.enabled = True
        updater = Updater({"x": value})
        updater.reset(Clock(), None)
        return updater.observation_spec()["x"]

    assert spec(None) == specs.BoundedArray((3, 2), float, 1, 4, "x")
    assert spec("mean") == specs.BoundedArray((2,), float, 1, 4, "x")
    with pytest.warns(UserWarning, match="bounds of observable 'x' are dropped"):
        assert spec("sum") == specs.Array((2,), float, "x")


def test_impossible_schedules_are_refused():
    for options, match in (({"update_interval": lambda: 0}, "at least 1"), ({"delay": -1}, "at least 0")):
        with pytest.raises(UsageError, match=match):
            observe({"x": Generic(lambda clock: 1.0, **options)}, 1, 1)
