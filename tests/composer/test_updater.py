"""When samples are taken and when they arrive, against a direct transcription of the nominal schedule."""

import contextlib

import numpy as np
import pytest
from dm_env import specs
from hypothesis import given
from hypothesis import strategies as st

from sim2real.composer.observation.observable import Generic
from sim2real.composer.observation.updater import Updater
from sim2real.composer.variation import deterministic, noises
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


def test_late_samples_are_ordered_by_arrival():
    value = Generic(
        lambda clock: clock.steps,
        buffer_size=3,
        update_interval=deterministic.Sequence([3, 2, 3, 3, 4, 1, 4]),
        delay=deterministic.Sequence([3, 5, 2, 5, 1, 2, 4]),
    )
    found = [f["value"].tolist() for f in observe({"value": value}, 10, 4)]
    assert found == [[0, 0, 0], [0, 5, 3], [8, 15, 16], [20, 25, 23], [28, 35, 36]]


def test_padding_and_shapes():
    late = Generic(lambda clock: 7.0 + clock.steps, delay=4, buffer_size=2)
    assert [f["late"].tolist() for f in observe({"late": late}, 2, 3)] == [[0, 0], [0, 0], [0, 7], [8, 9]]
    initial = observe({"late": late}, 2, 3, pad_with_initial_value=True)
    assert [f["late"].tolist() for f in initial] == [[7, 7], [7, 7], [7, 7], [8, 9]]
    single = Generic(lambda clock: 7.0, delay=1)
    assert observe({"x": single}, 1, 0, strip_singleton_buffer_dim=True, pad_with_initial_value=True)[0]["x"] == 7.0
    assert observe({"x": single}, 1, 0)[0]["x"].tolist() == [0.0]
    vector = Generic(lambda clock: [1, 2], buffer_size=3)
    assert observe({"x": vector}, 1, 0)[0]["x"].tolist() == [[0, 0], [0, 0], [1, 2]]


@pytest.mark.parametrize(("name", "expected"), [("min", 4), ("max", 6), ("mean", 5), ("median", 5), ("sum", 15)])
def test_aggregators_reduce_the_buffer(name, expected):
    value = Generic(lambda clock: clock.steps, buffer_size=3, aggregator=name)
    assert observe({"x": value}, 3, 2)[-1]["x"] == expected


def test_corruptors_see_the_samples_that_are_observed():
    seen = []
    noisy = Generic(lambda clock: clock.steps, corruptor=lambda v, random_state: seen.append(v) or v + 0.5)
    assert observe({"x": noisy}, 3, 1)[-1]["x"].tolist() == [3.5]
    assert seen == [0, 3]
    exact = Generic(lambda clock: 2.0, corruptor=noises.Additive(deterministic.Constant(0.25)))
    assert observe({"x": exact}, 1, 1)[-1]["x"].tolist() == [2.25]


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


def test_structures_are_kept_and_wrong_ones_refused():
    a, b = Generic(lambda clock: 1.0), Generic(lambda clock: 2.0)
    a.enabled = True
    updater = Updater(({"a": a}, {"b": b}))
    with pytest.raises(RuntimeError, match="reset"):
        updater.get_observation()
    updater.reset(Clock(), None)
    assert updater.get_observation() == ({"a": np.ones(1)}, {})
    with pytest.raises(ValueError, match="should be a dict"):
        Updater([a])


def test_impossible_schedules_are_refused():
    for options, match in (({"update_interval": lambda: 0}, "at least 1"), ({"delay": -1}, "at least 0")):
        with pytest.raises(UsageError, match=match):
            observe({"x": Generic(lambda clock: 1.0, **options)}, 1, 1)
