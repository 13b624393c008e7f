"""What lies between two messages, for every dtype: floats on a line, other values as the last message has them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.graph.base import InputState
from sim2real.graph.delays import TrainableDist

TS, LOW, HIGH, PERIOD = 0.2, 0.005, 0.05, 0.02
SENT = np.array([0.10, 0.12, 0.14, 0.16, 0.18])
DELAY = 0.034  # the last arrival before TS is that of 0.16, at 0.194; the next one comes at 0.214
HELD, NEXT = 3, 4
WHOLE = ["uint8", "int8", "uint16", "int16", "uint32", "int32"]


def values_of(dtype):
    """Return five messages that use the whole range of a dtype: the largest steps between the last two."""
    if dtype == "bool":
        return np.array([True, False, True, False, True])
    if dtype in WHOLE:
        limits = np.iinfo(dtype)
        return np.array([1, 2, 3, limits.max - 9, limits.min + 4], dtype)
    return np.array([1.0, 2.0, 3.0, 60_000.0, -60_000.0])


def served(values, interp, delay=DELAY, window=1, skip=False):
    """Return the window that a step at TS reads of five messages sent at SENT."""
    dist = TrainableDist.create(delay, LOW, HIGH, interp)
    stamps = jnp.asarray(SENT, jnp.float32)
    wide = InputState(jnp.arange(5, dtype=jnp.int32), stamps, stamps + LOW, values)
    return dist.apply(wide, jnp.float32(TS) - stamps, window, PERIOD, TS, skip)


@pytest.mark.parametrize("interp", ["linear", "zoh_mean", "zoh"])
@pytest.mark.parametrize("dtype", [*WHOLE, "bool"])
def test_integers_and_booleans_hold(interp, dtype):
    values, kind = values_of(dtype), jnp.asarray if interp == "zoh_mean" else np.asarray
    got = served({"v": kind(values), "pair": kind(np.stack([values, values[::-1]], axis=1))}, interp)
    assert got.data["v"].dtype == dtype
    assert got.data["v"][-1] == values[HELD]
    np.testing.assert_array_equal(got.data["pair"][-1], [values[HELD], values[::-1][HELD]])
    assert int(got.seq[-1]) == HELD


def test_keys_hold():
    keys = jax.random.split(jax.random.key(0), 5)
    got = served(keys, "linear").data
    np.testing.assert_array_equal(jax.random.key_data(got[-1]), jax.random.key_data(keys[HELD]))


@pytest.mark.parametrize("skip", [False, True])
def test_a_message_that_arrives_with_the_start_is_held_unless_skipped(skip):
    """At a delay of 0.04 s the message of 0.16 s arrives at 0.2 s exactly, up to float32."""
    for interp in ("linear", "zoh"):
        got = served(jnp.asarray([10, 20, 30, 40, 50], jnp.uint8), interp, delay=0.04, skip=skip)
        assert int(got.data[-1]) == (30 if skip else 40)


def test_before_the_first_message_an_integer_is_the_default():
    for interp in ("linear", "zoh"):
        dist = TrainableDist.create(0.034, LOW, HIGH, interp)
        stamps = jnp.asarray([0.0, 0.0, 0.18], jnp.float32)
        wide = InputState(jnp.asarray([-1, -1, 0]), stamps, stamps, jnp.asarray([7, 7, 200], jnp.uint8))
        got = dist.apply(wide, jnp.asarray([1e6, 1e6, 0.02], jnp.float32), 1, PERIOD, TS)
        assert (int(got.seq[0]), int(got.data[0])) == (-1, 7)


@pytest.mark.parametrize(("skip", "expected"), [(False, 3.0), (True, 2.0)])
def test_of_two_messages_that_arrive_at_once_the_later_one_holds_from_then_on(skip, expected):
    """A burst: the second and the third message were sent at the same time, and arrive with the start."""
    dist = TrainableDist.create(0.034, LOW, HIGH, "linear")
    stamps = jnp.asarray([0.12, 0.166, 0.166], jnp.float32)
    wide = InputState(jnp.arange(3), stamps, stamps + LOW, jnp.asarray([1.0, 2.0, 3.0]))
    got = dist.apply(wide, jnp.float32(TS) - stamps, 1, PERIOD, TS, skip)
    assert float(got.data[0]) == pytest.approx(expected)
